"""Command lines of stages: options, refusals, exit codes, and artifacts."""

import json
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import SimpleNamespace

import pytest

from pipeline.core.videos import Video
from pipeline.workflow import artifact, cli, dag

ROOT = Path(__file__).parents[3]
FRONT = '''"""Tell what this stage does."""

import errno
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from pipeline.core.errors import InputError
from pipeline.workflow import cli


@dataclass(frozen=True)
class Inputs:
    frames: Mapping[str, Path] | None = None
    scene_template: Path | None = None


@dataclass(frozen=True)
class Config:
    seed: int = 0
    """Seed."""
    end: str = "well"
    """How to end."""


def run(inputs, config, out, *, threads, device, video):
    (out / "a.txt").write_text(f"{config.seed} {threads} {device}")
    if inputs.frames is not None:
        (out / "found.txt").write_text(" ".join(inputs.frames))
    if video is not None:
        (out / "role.txt").write_text(video.role)
    if config.end == "refused":
        raise InputError("TST-001", "it is bad", "here", "make it good")
    if config.end == "full":
        raise OSError(errno.ENOSPC, "No space left on device", str(out))
    if config.end == "broken":
        raise ZeroDivisionError


if __name__ == "__main__":
    cli.main(__doc__, run, Inputs, Config)
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


def test_stage_runs_from_the_command_line(stage, tmp_path):
    (tmp_path / "slice.toml").write_text("seed = 4")
    assert stage("--out", "out", "--config", "slice.toml", "--threads", "2").returncode == 0
    manifest = artifact.opened(tmp_path / "out", "out")
    assert (tmp_path / "out/a.txt").read_text() == "4 2 cpu"
    assert (manifest.stage, manifest.key, manifest.config) == ("example", None, {"seed": 4, "end": "well"})


@pytest.mark.parametrize(
    ("end", "code", "message"),
    [
        ("refused", 2, "error: TST-001 here: it is bad\n  -> make it good\n"),
        ("full", 2, "error: SYS-001"),
        ("broken", 1, "Traceback"),
    ],
)
def test_exit_codes_of_failures(stage, tmp_path, end, code, message):
    (tmp_path / "slice.json").write_text(json.dumps({"end": end}))
    before = sorted(tmp_path.iterdir())
    failed = stage("--out", "out", "--config", "slice.json")
    assert failed.returncode == code
    assert failed.stderr.startswith(message)
    assert sorted(tmp_path.iterdir()) == before


@pytest.mark.parametrize(
    "arguments", [(), ("--out", "out", "--threads", "two"), ("--out", "out", "--tempo", "3")]
)
def test_invalid_command_line_is_refused_with_a_code(stage, arguments):
    failed = stage(*arguments)
    assert failed.returncode == 2
    assert failed.stderr.startswith("error: RUN-004 python -m stages.example: ")
    assert "usage" not in failed.stderr


def test_help_is_the_docstring(stage):
    usage = stage("--help").stdout
    assert "Tell what this stage does." in usage
    assert "--scene-template PATH" in usage
    assert "\n  seed = 0  Seed.\n  end = 'well'  How to end.\n" in usage


def test_incomplete_input_is_refused(stage, tmp_path):
    videos = [dict(id="v002", file="x", role="session", split="train", sha256=None)]
    (tmp_path / "videos.json").write_text(json.dumps(videos))
    (tmp_path / "frames" / "v002").mkdir(parents=True)
    call = ("--out", "out", "--frames", "frames", "--videos", "videos.json")
    assert stage(*call).stderr.startswith("error: ART-001 frames/v002")
    for wrote in ("segment_agent", "extract_frames"):
        with artifact.create(tmp_path / "frames/v002", stage=wrote, config={}, inputs={}) as folder:
            (folder / "x").write_text("x")
        if wrote == "segment_agent":
            assert stage(*call).stderr.startswith(
                "error: ART-006 frames/v002: is no frames: segment_agent wrote it"
            )
    assert stage(*call).returncode == 0
    assert (tmp_path / "out/found.txt").read_text() == "v002"
    content = artifact.opened(tmp_path / "frames/v002", "").content
    assert artifact.opened(tmp_path / "out", "").inputs == {"frames/v002": content}


def test_unlisted_recording_is_refused(stage, tmp_path):
    video = dict(id="v002", file="x", role="session", split="train", sha256=None)
    (tmp_path / "videos.json").write_text(json.dumps([video]))
    call = ("--out", "out", "--videos", "videos.json", "--video")
    assert stage(*call, "v002").returncode == 0
    assert (tmp_path / "out/role.txt").read_text() == "session"
    assert stage(*call, "v003").stderr.startswith("error: ART-004 example: which recording is 'v003'?")


def test_only_the_first_of_several_processes_publishes(stage, tmp_path, monkeypatch):
    monkeypatch.setenv("TORCHELASTIC_RUN_ID", "none")
    monkeypatch.setenv("RANK", "1")
    assert stage("--out", "out").returncode == 0
    assert not (tmp_path / "out").exists()
    monkeypatch.setenv("RANK", "0")
    assert stage("--out", "out").returncode == 0
    assert artifact.opened(tmp_path / "out", "out").stage == "example"


def test_inputs_are_derived_from_the_fields():
    @dataclass(frozen=True)
    class Inputs:
        frames: Mapping[str, Path]
        masks: Mapping[str, Path] | None
        registration: Path
        truth: Path | None

    kinds = {field.name: (field.required, field.several) for field in cli.input_fields(Inputs)}
    assert kinds == {
        "frames": (True, True),
        "masks": (False, True),
        "registration": (True, False),
        "truth": (False, False),
    }


@pytest.mark.parametrize(
    ("stage", "field", "expected"),
    [
        ("build_scene_template", "frames", ["v000"]),
        ("build_agent_template", "masks", ["v001"]),
        ("fit_feature_basis", "frames", ["v000", "v001", "v002"]),
        ("reconstruct", "frames", ["v000", "v001", "v002", "v003"]),
        ("reconstruct", "masks", ["v001", "v002", "v003"]),
        ("evaluate.reconstruction_metrics", "frames", ["v000", "v001", "v002", "v003", "v004"]),
        ("tabulate_behavior", "behavior_trials", ["ats-0", "ats-1", "world-0", "world-1"]),
    ],
)
def test_fields_receive_recordings_and_trials_of_the_flow(tmp_path, stage, field, expected):
    node = dag.NODES[field]
    for name in expected:
        with artifact.create(tmp_path / field / name, stage=node.stage, config={}, inputs={}) as folder:
            (folder / "x").write_text("x")
    roles = [
        ("walkthrough", "none"),
        ("turnaround", "none"),
        ("session", "train"),
        ("session", "test"),
        ("heldout", "none"),
    ]
    videos = tuple(Video(f"v{i:03d}", f"{i}", role, split, None) for i, (role, split) in enumerate(roles))
    settings = SimpleNamespace(methods=("ats", "world"), seeds=2)
    task = cli.Task(stage, settings, videos, {field: tmp_path / field})
    found = task.field(cli.InputField(field, required=True, several=True))
    assert found == {name: tmp_path / field / name for name in expected}
