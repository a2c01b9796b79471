"""Bad recordings end in one clear error with its code, and change nothing on disk."""

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
def house(tmp_path_factory):
    """A working copy with recordings of its own: one good walk-through under several names."""
    folder = tmp_path_factory.mktemp("house")
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


def run(house, *module):
    return subprocess.run([sys.executable, "-SE", "-m", *module], cwd=house, capture_output=True, text=True)


def tree(house):
    """Every file but caches, locks, and what a failed job reports about itself: its log and exit code."""
    apart = {"__pycache__", "logs", "failures", "locks"}
    files = (path for path in house.rglob("*") if path.is_file() and not apart & set(path.parts))
    return {path.relative_to(house).as_posix(): path.read_bytes() for path in files}


def truncated(good: Path, bad: Path) -> None:
    bad.write_bytes(good.read_bytes()[: good.stat().st_size // 2])


def bomb(good: Path, bad: Path) -> None:
    """A depth picture that unpacks to a gigabyte."""
    shutil.copy(good, bad)
    with (
        zipfile.ZipFile(bad, "a", zipfile.ZIP_DEFLATED) as archive,
        archive.open("rgbd/9999.depth", "w") as member,
    ):
        for _ in range(1 << 8):
            member.write(bytes(1 << 20))


def face_id(good: Path, bad: Path) -> None:
    """Another camera type and no device poses, as the Face-ID camera leaves them."""
    with zipfile.ZipFile(good) as source, zipfile.ZipFile(bad, "w") as archive:
        for name in source.namelist():
            data = source.read(name)
            if name == "metadata":
                told = json.loads(data)
                told["cameraType"] = 0
                told["poses"] = [[0, 0, 0, 1, 0, 0, 0]] * len(told["poses"])
                data = json.dumps(told).encode()
            archive.writestr(name, data)


def no_recording(good: Path, bad: Path) -> None:
    bad.write_bytes(zlib.compress(good.read_bytes()))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("spoil", "code"),
    [(truncated, "CAP-001"), (no_recording, "CAP-001"), (bomb, "CAP-002"), (face_id, "CAP-005")],
)
def test_a_bad_recording(house, spoil, code):
    captures = house / "captures" / "luna"
    spoil(captures / "walkthrough.r3d", captures / "session.r3d")
    assert run(house, "pipeline.workflow.plan", "plan", "luna").returncode == 0
    before = tree(house)
    refused = run(house, "pipeline.workflow.run", "luna", "frames.v002")
    assert refused.returncode == 2, refused.stderr
    errors = [line for line in refused.stderr.splitlines() if "error:" in line]
    assert len(errors) == 1, refused.stderr
    assert f"error: {code} " in errors[0]
    assert "session.r3d" in errors[0]
    assert "Traceback" not in refused.stderr
    assert tree(house) == before


def test_a_good_one(house):
    shutil.copy(house / "captures/luna/walkthrough.r3d", house / "captures/luna/session.r3d")
    assert run(house, "pipeline.workflow.plan", "plan", "luna").returncode == 0
    made = run(house, "pipeline.workflow.run", "luna", "frames.v000")
    assert made.returncode == 0, made.stderr
