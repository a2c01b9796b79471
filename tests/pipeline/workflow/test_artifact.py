"""Artifacts are complete or absent."""

import json
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from pipeline.core.errors import InputError
from pipeline.workflow import artifact

ROOT = Path(__file__).parents[3]


def make(out: Path, text: str, key: str | None = "k") -> None:
    with artifact.create(out, stage="s", config={"seed": 1}, inputs={"b": "2", "a": "1"}, key=key) as folder:
        (folder / "inner").mkdir()
        (folder / "inner" / "data.txt").write_text(text)


def test_manifest_describes_the_files(tmp_path):
    make(tmp_path / "x", "hello")
    manifest = artifact.opened(tmp_path / "x", "x")
    assert manifest.key == "k"
    assert manifest.files == artifact.digests(tmp_path / "x")
    assert manifest.content == artifact.digest_of(manifest.files)
    assert [path.name for path in tmp_path.iterdir()] == ["x"]


def test_equal_files_have_equal_content_and_bytes(tmp_path):
    for name in ("x", "y"):
        make(tmp_path / name, "hello")
    assert (tmp_path / "x/manifest.json").read_bytes() == (tmp_path / "y/manifest.json").read_bytes()
    make(tmp_path / "y", "other")
    assert artifact.opened(tmp_path / "x", "x").content != artifact.opened(tmp_path / "y", "y").content


@pytest.mark.parametrize("before", [False, True])
def test_failed_writer_keeps_the_old_artifact(tmp_path, before):
    if before:
        make(tmp_path / "x", "old")
    with (
        pytest.raises(RuntimeError),
        artifact.create(tmp_path / "x", stage="s", config={}, inputs={}) as folder,
    ):
        (folder / "half.txt").write_text("new")
        raise RuntimeError
    assert [path.name for path in tmp_path.iterdir()] == (["x"] if before else [])
    if before:
        assert (tmp_path / "x/inner/data.txt").read_text() == "old"


SOUND = {
    "stage": "s", "key": "k", "content": "c", "inputs": {}, "config": {}, "versions": {}, "files": {"a": "b"},
}  # fmt: skip


@pytest.mark.parametrize(
    "text",
    [
        "[" * 200_000,
        '{"a":' * 200_000,
        "[1]",
        "null",
        "",
        *(json.dumps(SOUND | {name: value}) for name in SOUND for value in (3, ["x"], {"x": 3}, None)
          if (name, value) not in (("key", None), ("config", {"x": 3}))),
    ],
)  # fmt: skip
def test_invalid_manifest_is_refused(tmp_path, text):
    (tmp_path / "manifest.json").write_text(text)
    with pytest.raises(InputError, match="ART-001"):
        artifact.opened(tmp_path, "x")
    assert artifact.damaged(tmp_path) == []


def test_empty_artifact_is_refused(tmp_path):
    with (
        pytest.raises(InputError, match="ART-002"),
        artifact.create(tmp_path / "x", stage="s", config={}, inputs={}),
    ):
        pass
    assert list(tmp_path.iterdir()) == []


def test_folder_without_manifest_is_no_artifact(tmp_path):
    with pytest.raises(InputError, match="ART-001"):
        artifact.opened(tmp_path, "frames")
    (tmp_path / "manifest.json").write_text('{"half":')
    assert artifact.read_manifest(tmp_path) is None


def test_killed_writer_keeps_the_old_artifact(tmp_path):
    """SIGKILL while writing: the old artifact is kept, and the next job removes the rest."""
    make(tmp_path / "x", "old")
    program = (
        "import os, signal\nfrom pathlib import Path\nfrom pipeline.workflow import artifact\n"
        f"out = Path({str(tmp_path / 'x')!r})\n"
        "with artifact.create(out, stage='s', config={}, inputs={}) as folder:\n"
        "    (folder / 'half.txt').write_text('new')\n    os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    killed = subprocess.run(
        [sys.executable, "-c", program], cwd=ROOT, env={**os.environ, "PYTHONPATH": str(ROOT)}
    )
    assert killed.returncode == -signal.SIGKILL
    assert len(list(tmp_path.iterdir())) == 2
    artifact.clean(tmp_path / "x")
    assert [path.name for path in tmp_path.iterdir()] == ["x"]
    assert (tmp_path / "x/inner/data.txt").read_text() == "old"


def test_unchanged_file_keeps_its_modification_time(tmp_path):
    path = tmp_path / "deep" / "file"
    assert artifact.write_if_changed(path, "a")
    os.utime(path, ns=(1, 1))
    assert not artifact.write_if_changed(path, "a")
    assert path.stat().st_mtime_ns == 1
    assert artifact.write_if_changed(path, "b")
