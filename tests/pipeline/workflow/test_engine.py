"""Snakemake: homes, resources, and several agents in one call."""

import os
import shutil
import sys
from types import SimpleNamespace

import pytest

from pipeline.core.errors import InputError
from pipeline.workflow import dag, engine
from tests.pipeline.workflow import checkout


@pytest.fixture
def small_checkout(tmp_path, monkeypatch):
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
    table.write_text("\ufeffagent\tvariant\nluna\t\ncat\tno_scene\n")  # as spreadsheets save it
    assert engine.homes({"homes": str(table)}) == ["luna", "cat/variants/no_scene"]


@pytest.mark.parametrize("text", ["name\nluna\n", "agent\n", "", "\xff\xfe\x00"])
def test_invalid_table_of_homes_is_refused(tmp_path, text):
    (tmp_path / "homes.tsv").write_bytes(text.encode("latin-1"))
    with pytest.raises(InputError, match="REC-003"):
        engine.homes({"homes": str(tmp_path / "homes.tsv")})
    with pytest.raises(InputError, match="REC-004"):
        engine.homes({"agents": ["../x"]})


def test_unknown_options_are_refused():
    with pytest.raises(InputError, match="REC-001 snakemake --config: unknown key 'agnet'"):
        engine.homes({"agnet": "luna"})


def test_resources_grow_with_frames_and_attempts(small_checkout):
    small_checkout.plan()
    node, home = dag.NODES["reconstruction"], SimpleNamespace(home="toy")
    unknown = engine.memory_mb(node, home, 1)
    for cached in (engine._frames, engine._frames_in):
        cached.cache_clear()
    for video in ("v000", "v001", "v002", "v003"):
        color = small_checkout.folder / f"build/toy/frames/{video}/color"
        color.mkdir(parents=True)
        for frame in range(10):
            (color / f"{frame:06d}.jpg").touch()
    known = engine.memory_mb(node, home, 1)
    assert engine.MEMORY_MB < known < unknown
    assert engine.memory_mb(node, home, 2) == pytest.approx(engine.MEMORY_GROWTH * known, abs=1)
    assert engine.runtime_min(node, home, 2) > 1.9 * engine.runtime_min(node, home, 1) - 2


@pytest.mark.slow
def test_snakemake_builds_several_agents(small_checkout):
    shutil.copy(small_checkout.folder / "agents/toy.toml", small_checkout.folder / "agents/luna.toml")
    targets = [f"build/{agent}/flow/v001/.ok" for agent in ("toy", "luna")]
    options = "--cores 2 --config agents=[toy,luna] --quiet all --".split()
    made = small_checkout.snakemake(*options, *targets)
    assert made.returncode == 0, made.stderr
    assert all((small_checkout.folder / target).is_file() for target in targets)
    assert not (small_checkout.folder / "build/toy/masks").exists()


APPTAINER = """#!/bin/sh
[ "$1" = --version ] && { echo apptainer version 1.3.0; exit; }
echo "$*" >>calls.txt
while [ "$1" != sh ] && [ "$1" != bash ]; do shift; done
PATH=image:$PATH exec "$@"
"""
"""A fake apptainer that logs its arguments and runs the command with the `python` of the image."""


@pytest.mark.slow
def test_jobs_run_in_the_given_container(small_checkout, monkeypatch):
    for name, text in (
        ("bin/apptainer", APPTAINER),
        ("image/python", f'#!/bin/sh\nexec {sys.executable} "$@"\n'),
    ):
        small_checkout.write(name, text)
        (small_checkout.folder / name).chmod(0o755)
    small_checkout.write("agent-to-sim.sif", "")
    monkeypatch.setenv("PATH", f"{small_checkout.folder}/bin:{os.environ['PATH']}")
    options = "--cores 1 --quiet all --software-deployment-method apptainer".split()
    target = "build/toy/frames/v001/.ok"
    made = small_checkout.snakemake(
        *options, "--config", "agent=toy", "container=agent-to-sim.sif", "--", target
    )
    assert made.returncode == 0, made.stderr
    assert (small_checkout.folder / target).is_file()
    calls = (small_checkout.folder / "calls.txt").read_text().splitlines()
    assert sum("agent-to-sim.sif" in call and "pipeline.workflow.run" in call for call in calls) == 2
