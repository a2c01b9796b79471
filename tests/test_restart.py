"""Kill the toy build twelve times while stages write, without ground truth on disk; the artifacts are byte-identical.

Artifacts that are never killed, and those of all recordings but one, are copied from the toy. `benchmarks.faults` kills
whole builds hundreds of times.
"""

import contextlib
import os
import random
import shutil
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from pipeline.workflow import artifact, dag
from tests.pipeline.workflow import checkout

ROOT = Path(__file__).parent.parent
pytestmark = pytest.mark.toy

KILLS = {
    "frames": 2, "flow": 1, "masks": 2, "feature_basis": 1, "features": 1, "behavior_data": 1,
    "reconstruction": 2, "splats": 1, "behavior": 1,
}  # fmt: skip
"""Number of kills per artifact while it, or a checkpoint of its training, is written."""
TRAININGS = ("reconstruction", "splats", "behavior")
RECORDING = "v001"
"""The recording whose own artifacts are written here, the turnaround."""
BUILT = [node.artifact for node in dag.nodes_of("recordings") if not (node.on_demand or node.mapped)]
"""Artifacts of `make toy`."""
FROM_TRUTH = ("reconstruction_metrics", "evaluation", "report")
"""Artifacts that depend on the ground truth."""
LIMIT_S = 3600
"""Time limit until the next artifact is written."""


@pytest.fixture(scope="module")
def copy(toy, tmp_path_factory) -> Path:
    """A working copy with the toy's recordings, without ground truth, and its artifacts that are not rebuilt."""
    folder = tmp_path_factory.mktemp("restart")
    for name in ("pipeline", "stages", "agents", "envs"):
        shutil.copytree(
            ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__", "node_modules")
        )
    shutil.copy(ROOT / "Makefile", folder)
    (folder / ".venv").symlink_to(ROOT / ".venv")
    shutil.copytree(toy / "synthetic_capture", folder / "build/toy/synthetic_capture")
    shutil.rmtree(folder / "build/toy/synthetic_capture/truth")
    for name in set(BUILT) - {"synthetic_capture", *FROM_TRUTH}:
        shutil.copytree(toy / name, folder / "build/toy" / name)
    for name in KILLS:
        shutil.rmtree(written_here(folder, name))
    return folder


def written_here(folder: Path, name: str) -> Path:
    """Return the folder of artifact `name` that is written in the copy."""
    return folder / "build/toy" / name / (RECORDING if dag.NODES[name].roles else "")


def start_build(folder: Path) -> subprocess.Popen[bytes]:
    """Start a build of everything that does not depend on the ground truth, in its own process group."""
    goals = [f"toy.{name}" for name in BUILT if name not in FROM_TRUTH]
    with (folder / "build.log").open("ab") as log:
        return subprocess.Popen(
            ["make", "-j2", *goals], cwd=folder, start_new_session=True, stdout=log, stderr=log
        )


def being_written(folder: Path, name: str) -> Iterator[Path]:
    """Yield the temporary folders of artifact `name`, or the checkpoints of its training."""
    build = folder / "build" / "toy"
    if name in TRAININGS:
        yield from (build / "resume" / name).rglob("step*[1-9]*.pt")
    elif dag.NODES[name].roles:
        yield from (build / name).glob(".*.tmp.*")
    else:
        yield from build.glob(f".{name}.tmp.*")


def kill_while_writing(folder: Path, names: list[str], choice: random.Random) -> tuple[str, str]:
    """Build until one of `names` is being written, then SIGKILL the group; return its name and the temporary path.

    A kill after the write has ended does not count; if a build ends before one counts, the artifacts are rebuilt.
    """
    end = time.monotonic() + LIMIT_S
    while time.monotonic() < end:
        left_over = {path for name in names for path in being_written(folder, name)}
        new: list[tuple[str, Path]] = []
        build = start_build(folder)
        while build.poll() is None and not new and time.monotonic() < end:
            time.sleep(0.002)
            new = [
                (name, path)
                for name in names
                for path in being_written(folder, name)
                if path not in left_over
            ]
        if new:
            time.sleep(choice.uniform(0, 0.3 if new[0][0] in TRAININGS else 0.02))
        with contextlib.suppress(ProcessLookupError):
            os.killpg(build.pid, signal.SIGKILL)
        code = build.wait()
        checkout.wait_for_group(build.pid)
        if not new:
            assert code == 0, (folder / "build.log").read_text()[-3000:]
            for name in names:
                shutil.rmtree(written_here(folder, name))
        elif new[0][1].exists():
            return new[0][0], str(new[0][1].relative_to(folder))
    raise AssertionError(f"{names} were never killed while they were written")


def complete(folder: Path) -> dict[str, artifact.Manifest]:
    """Return every complete artifact, each checked against its files."""
    found = {}
    for path in (folder / "build" / "toy").rglob(artifact.MANIFEST):
        inside = path.parent.relative_to(folder / "build" / "toy")
        if inside.parts[0] == "synthetic_capture" or any(part.startswith(".") for part in inside.parts):
            continue
        manifest = artifact.read_manifest(path.parent)
        assert manifest is not None, path
        assert manifest.files == artifact.digests(path.parent), f"{inside} has a manifest but is incomplete"
        found[inside.as_posix()] = manifest
    return found


@pytest.fixture(scope="module")
def rebuilt(copy, toy, pytestconfig) -> Path:
    """Rebuild the copy with kills, printing each, then finish the build."""
    choice = random.Random(20)
    remaining_kills = dict(KILLS)
    shown = pytestconfig.pluginmanager.getplugin("capturemanager").global_and_fixture_disabled
    while any(remaining_kills.values()):
        name, there = kill_while_writing(
            copy, [name for name in remaining_kills if remaining_kills[name]], choice
        )
        remaining_kills[name] -= 1
        count = sum(KILLS.values()) - sum(remaining_kills.values())
        with shown():
            print(
                f"kill {count:2} during {name}, beside {there}; {len(complete(copy))} artifacts complete",
                flush=True,
            )
    assert start_build(copy).wait() == 0, (copy / "build.log").read_text()[-3000:]
    return copy


def test_trainings_resumed_from_checkpoints(rebuilt):
    log = (rebuilt / "build.log").read_text()
    for name in TRAININGS:
        steps = [
            int(line.rsplit(" ", 1)[1])
            for line in log.splitlines()
            if line.startswith(f"[{name}] resumed at step")
        ]
        assert any(step > 0 for step in steps), f"{name} started from scratch"


def test_artifacts_equal_those_of_the_toy_build(rebuilt, toy):
    """Files and manifests are byte-identical, although this build has no ground truth."""
    assert not (rebuilt / "build/toy/synthetic_capture/truth").exists()
    done = complete(rebuilt)
    assert {name.split("/")[0] for name in done} == set(BUILT) - {"synthetic_capture", *FROM_TRUTH}
    assert [
        name for name, manifest in done.items() if manifest.files != artifact.opened(toy / name, name).files
    ] == []
    for name in done:
        assert (rebuilt / "build/toy" / name / artifact.MANIFEST).read_bytes() == (
            toy / name / artifact.MANIFEST
        ).read_bytes()


def test_no_temporary_folders_remain(rebuilt):
    build = rebuilt / "build" / "toy"
    assert [path for pattern in (".*.tmp*", ".*.old*") for path in build.rglob(pattern)] == []
    assert list((build / "resume").iterdir()) == []
