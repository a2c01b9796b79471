"""Invalid recordings give one error with its code and leave the disk unchanged."""

import json
import shutil
import subprocess
import sys
import zipfile
import zlib
from pathlib import Path

import pytest

from tests.stages.extract_frames import made_recordings

ROOT = Path(__file__).parent.parent


@pytest.fixture(scope="module")
def checkout(tmp_path_factory):
    """A working copy with one valid walk-through, also used as turnaround."""
    folder = tmp_path_factory.mktemp("checkout")
    for name in ("pipeline", "stages"):
        shutil.copytree(
            ROOT / name, folder / name, ignore=shutil.ignore_patterns("__pycache__", "node_modules")
        )
    (folder / "agents").mkdir()
    (folder / "agents" / "luna.toml").touch()
    captures = folder / "captures" / "luna"
    captures.mkdir(parents=True)
    made_recordings.walk().write(captures / "walkthrough.r3d")
    shutil.copy(captures / "walkthrough.r3d", captures / "turnaround.r3d")
    return folder


def run(checkout, *module):
    return subprocess.run(
        [sys.executable, "-SE", "-m", *module], cwd=checkout, capture_output=True, text=True
    )


def tree(checkout):
    """All files except caches, locks, and the log and exit code of a failed job."""
    ignored = {"__pycache__", "logs", "failures", "locks"}
    files = (path for path in checkout.rglob("*") if path.is_file() and not ignored & set(path.parts))
    return {path.relative_to(checkout).as_posix(): path.read_bytes() for path in files}


def truncated(valid: Path, invalid: Path) -> None:
    invalid.write_bytes(valid.read_bytes()[: valid.stat().st_size // 2])


def zip_bomb(valid: Path, invalid: Path) -> None:
    """Add a depth picture that decompresses to 256 MB."""
    shutil.copy(valid, invalid)
    with (
        zipfile.ZipFile(invalid, "a", zipfile.ZIP_DEFLATED) as archive,
        archive.open("rgbd/9999.depth", "w") as member,
    ):
        for _ in range(1 << 8):
            member.write(bytes(1 << 20))


def face_id(valid: Path, invalid: Path) -> None:
    """Set the camera type and constant poses of a recording by the Face ID camera."""
    with zipfile.ZipFile(valid) as source, zipfile.ZipFile(invalid, "w") as archive:
        for name in source.namelist():
            data = source.read(name)
            if name == "metadata":
                metadata = json.loads(data)
                metadata["cameraType"] = 0
                metadata["poses"] = [[0, 0, 0, 1, 0, 0, 0]] * len(metadata["poses"])
                data = json.dumps(metadata).encode()
            archive.writestr(name, data)


def unknown_format(valid: Path, invalid: Path) -> None:
    invalid.write_bytes(zlib.compress(valid.read_bytes()))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("corrupt", "code"),
    [(truncated, "CAP-001"), (unknown_format, "CAP-001"), (zip_bomb, "CAP-002"), (face_id, "CAP-005")],
)
def test_invalid_recording_is_refused_with_its_code(checkout, corrupt, code):
    captures = checkout / "captures" / "luna"
    corrupt(captures / "walkthrough.r3d", captures / "session.r3d")
    assert run(checkout, "pipeline.workflow.plan", "plan", "luna").returncode == 0
    before = tree(checkout)
    refused = run(checkout, "pipeline.workflow.run", "luna", "frames.v002")
    assert refused.returncode == 2, refused.stderr
    errors = [line for line in refused.stderr.splitlines() if "error:" in line]
    assert len(errors) == 1, refused.stderr
    assert f"error: {code} " in errors[0]
    assert "session.r3d" in errors[0]
    assert "Traceback" not in refused.stderr
    assert tree(checkout) == before


def test_valid_recording_is_extracted(checkout):
    shutil.copy(checkout / "captures/luna/walkthrough.r3d", checkout / "captures/luna/session.r3d")
    assert run(checkout, "pipeline.workflow.plan", "plan", "luna").returncode == 0
    made = run(checkout, "pipeline.workflow.run", "luna", "frames.v000")
    assert made.returncode == 0, made.stderr
