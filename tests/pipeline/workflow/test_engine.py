"""What the Snakefile is told: homes, resources, and several agents in one call."""

import os
import shutil
import subprocess
import sys
from types import SimpleNamespace

import pytest

from pipeline.core.errors import InputError
from pipeline.workflow import dag, engine
from tests.pipeline.workflow import checkout


@pytest.fixture
def house(tmp_path, monkeypatch):
    made = checkout.create(tmp_path)
    monkeypatch.chdir(tmp_path)
    engine._known.clear()
    for cached in (engine._frames, engine._frames_in):
        cached.cache_clear()
    return made


def test_homes_are_one_agent_several_or_a_table(tmp_path):
    assert engine.homes({}) == ["cat"]
    assert engine.homes({"agent": "luna", "variant": "no_scene"}) == ["luna/variants/no_scene"]
    assert engine.homes({"agents": ["luna", "cat"]}) == ["luna", "cat"]
    table = tmp_path / "homes.tsv"
    table.write_text("agent\tvariant\nluna\t\ncat\tno_scene\n")
    assert engine.homes({"homes": str(table)}) == ["luna", "cat/variants/no_scene"]


@pytest.mark.parametrize("text", ["name\nluna\n", "\xff\xfe\x00"])
def test_a_table_of_homes_that_is_none_is_refused(tmp_path, text):
    (tmp_path / "homes.tsv").write_bytes(text.encode("latin-1"))
    with pytest.raises(InputError, match="REC-003"):
        engine.homes({"homes": str(tmp_path / "homes.tsv")})
    with pytest.raises(InputError, match="REC-004"):
        engine.homes({"agents": ["../x"]})


def test_memory_and_time_grow_with_frames_and_attempts(house):
    house.python("pipeline.workflow.plan", "plan", "toy")
    node, home = dag.NODES["reconstruction"], SimpleNamespace(home="toy")
    unknown = engine.memory_mb(node)(home, 1)
    for cached in (engine._frames, engine._frames_in):
        cached.cache_clear()
    for video in ("v000", "v001", "v002", "v003"):
        color = house.folder / f"build/toy/frames/{video}/color"
        color.mkdir(parents=True)
        for frame in range(10):
            (color / f"{frame:06d}.jpg").touch()
    known = engine.memory_mb(node)(home, 1)
    assert node.memory_mb < known < unknown
    assert engine.memory_mb(node)(home, 2) == pytest.approx(engine.MEMORY_GROWTH * known, abs=1)
    assert engine.runtime_min(node)(home, 2) > 1.9 * engine.runtime_min(node)(home, 1) - 2


@pytest.mark.slow
def test_snakemake_builds_several_agents(house):
    shutil.copy(house.folder / "agents/toy.toml", house.folder / "agents/luna.toml")
    command = [
        sys.executable,
        "-m",
        "snakemake",
        "--cores",
        "2",
        "--config",
        "agents=[toy,luna]",
        "--quiet",
        "all",
    ]
    targets = [f"build/{agent}/flow/v001/.ok" for agent in ("toy", "luna")]
    made = subprocess.run([*command, "--", *targets], cwd=house.folder, capture_output=True, text=True)
    assert made.returncode == 0, made.stderr
    assert all((house.folder / target).is_file() for target in targets)
    assert not (house.folder / "build/toy/masks").exists()


APPTAINER = """#!/bin/sh
[ "$1" = --version ] && { echo apptainer version 1.3.0; exit; }
echo "$*" >>calls.txt
while [ "$1" != sh ] && [ "$1" != bash ]; do shift; done
PATH=image:$PATH exec "$@"
"""
"""What it is asked for is written down, and done here with the `python` that is the image's."""


@pytest.mark.slow
def test_jobs_run_in_the_container_that_is_named(house, monkeypatch):
    for name, text in (
        ("bin/apptainer", APPTAINER),
        ("image/python", f'#!/bin/sh\nexec {sys.executable} "$@"\n'),
    ):
        house.write(name, text)
        (house.folder / name).chmod(0o755)
    house.write("agent-to-sim.sif", "")
    monkeypatch.setenv("PATH", f"{house.folder}/bin:{os.environ['PATH']}")
    command = [sys.executable, "-m", "snakemake", "--cores", "1", "--quiet", "all"]
    command += [
        "--software-deployment-method",
        "apptainer",
        "--config",
        "agent=toy",
        "container=agent-to-sim.sif",
    ]
    target = "build/toy/frames/v001/.ok"
    made = subprocess.run([*command, "--", target], cwd=house.folder, capture_output=True, text=True)
    assert made.returncode == 0, made.stderr
    assert (house.folder / target).is_file()
    calls = (house.folder / "calls.txt").read_text().splitlines()
    assert sum("agent-to-sim.sif" in call and "pipeline.workflow.run" in call for call in calls) == 2
