"""The door of a stage: options, refusals, exit codes, and the artifact it leaves."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from pipeline import artifact

ROOT = Path(__file__).parents[2]
FRONT = '''"""Tell what this stage does."""

import errno
from dataclasses import dataclass

from pipeline import cli
from pipeline.errors import InputError


@dataclass(frozen=True)
class Config:
    seed: int = 0
    """Seed."""
    end: str = "well"
    """How to end."""


def run(task):
    with task.create() as folder:
        (folder / "a.txt").write_text(f"{task.config.seed} {task.threads} {task.device}")
        if "frames" in task.paths and task.videos:
            (folder / "found.txt").write_text(" ".join(task.per_video("frames", roles=("session",), splits=("train",))))
        if task.config.end == "refused":
            raise InputError("TST-001", "it is bad", "here", "make it good")
        if task.config.end == "full":
            raise OSError(errno.ENOSPC, "No space left on device", str(folder))
        if task.config.end == "broken":
            raise ZeroDivisionError


if __name__ == "__main__":
    cli.enter(__doc__, run, config=Config, optional=("frames", "scene_template"))
'''


@pytest.fixture
def stage(tmp_path):
    (tmp_path / "pipeline").symlink_to(ROOT / "pipeline")
    front = tmp_path / "stages" / "example" / "__main__.py"
    front.parent.mkdir(parents=True)
    front.write_text(FRONT)

    def call(*arguments):
        command = [sys.executable, "-m", "stages.example", "--device", "cpu", *arguments]
        return subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)

    return call


def test_a_stage_runs_by_hand(stage, tmp_path):
    (tmp_path / "slice.toml").write_text("seed = 4")
    assert stage("--out", "out", "--config", "slice.toml", "--threads", "2").returncode == 0
    manifest = artifact.opened(tmp_path / "out", "out")
    assert (tmp_path / "out/a.txt").read_text() == "4 2 cpu"
    assert (manifest.stage, manifest.key, manifest.config) == ("example", None, {"seed": 4, "end": "well"})


@pytest.mark.parametrize(
    ("end", "code", "told"),
    [("refused", 2, "error: TST-001 here: it is bad\n  -> make it good\n"), ("full", 2, "error: SYS-001"), ("broken", 1, "Traceback")],
)
def test_ways_to_fail(stage, tmp_path, end, code, told):
    (tmp_path / "slice.json").write_text(json.dumps({"end": end}))
    before = sorted(tmp_path.iterdir())
    failed = stage("--out", "out", "--config", "slice.json")
    assert failed.returncode == code
    assert failed.stderr.startswith(told)
    assert sorted(tmp_path.iterdir()) == before


def test_help_is_the_docstring(stage):
    told = stage("--help").stdout
    assert "Tell what this stage does." in told
    assert "--scene-template PATH" in told
    assert "\n  seed = 0  Seed.\n  end = 'well'  How to end.\n" in told


def test_an_input_must_be_finished(stage, tmp_path):
    videos = [
        dict(id="v002", file="x", role="session", split="train", sha256=None),
        dict(id="v003", file="y", role="session", split="test", sha256=None),
    ]
    (tmp_path / "videos.json").write_text(json.dumps(videos))
    (tmp_path / "frames" / "v002").mkdir(parents=True)
    call = ("--out", "out", "--frames", "frames", "--videos", "videos.json")
    assert stage(*call).stderr.startswith("error: ART-001 frames/v002")
    for wrote in ("segment_agent", "extract_frames"):
        with artifact.create(tmp_path / "frames/v002", stage=wrote, config={}, inputs={}) as folder:
            (folder / "x").write_text("x")
        if wrote == "segment_agent":
            assert stage(*call).stderr.startswith("error: ART-006 frames/v002: is no frames: segment_agent wrote it")
    assert stage(*call).returncode == 0
    assert (tmp_path / "out/found.txt").read_text() == "v002"
    content = artifact.opened(tmp_path / "frames/v002", "").content
    assert artifact.opened(tmp_path / "out", "").inputs == {"frames/v002": content}
