"""Damaged, malicious and unsuitable recordings are refused with their code and leave no files."""

import struct
import sys
import zipfile

import lzfse
import numpy as np
import pytest

from pipeline.core.errors import InputError
from pipeline.data import images
from pipeline.recordings import record3d
from pipeline.workflow import cli
from stages.extract_frames import __main__ as front
from stages.extract_frames import stage, writing
from stages.extract_frames.config import Config
from tests.stages.extract_frames.made_recordings import walk, write_zip


def _refused(recording, folder, monkeypatch, capsys):
    """Run the stage, expect exit code 2 and an unchanged disk, return the message."""
    before = sorted(folder.rglob("*"))
    monkeypatch.setattr(
        sys, "argv", ["extract_frames", "--recording", str(recording), "--out", str(folder / "out")]
    )
    with pytest.raises(SystemExit) as stop:
        cli.main(front.__doc__, stage.run, stage.Inputs, Config)
    assert stop.value.code == 2
    assert sorted(folder.rglob("*")) == before
    return capsys.readouterr().err


def huge_jpeg() -> bytes:
    """A small JPEG whose header asks for 60,000 x 60,000 pixels."""
    data = bytearray(images.encode_jpeg(np.zeros((8, 8, 3), np.uint8)))
    at = data.find(b"\xff\xc0") + 5
    data[at : at + 4] = struct.pack(">2H", 60_000, 60_000)
    return bytes(data)


DEPTH = "rgbd/3.depth"
CASES = {
    "CAP-003": [{"members": {"metadata": None}}],
    "CAP-004": [
        {"members": {"metadata": b"{"}},
        {"members": {"metadata": b"[" * 60_000}},
        {"metadata": {"K": None}},
        {"metadata": {"K": [1, 2]}},
        {"metadata": {"w": 1e9}},
        {"metadata": {"w": float("nan")}},
        {"metadata": {"frameTimestamps": [0.0] * 12}},
        {"metadata": {"h": 62}},
    ],
    "CAP-005": [{"metadata": {"cameraType": 0}}, {"metadata": {"dw": 480, "dh": 640}}],
    "CAP-006": [{"members": {f"rgbd/{i}.depth": None for i in range(12)}}],
    "CAP-007": [
        {"members": {f"rgbd/{i}.jpg": None for i in range(12)}},
        {
            "members": {
                f"rgbd/{i}.depth": lzfse.compress(np.full(768, np.nan, "<f4").tobytes()) for i in range(12)
            }
        },
    ],
    "CAP-008": [
        {"members": {DEPTH: lzfse.compress(b"\0" * 100)}},
        {"members": {DEPTH: lzfse.compress(bytes(10**6))}},
    ],
    "CAP-001": [{"members": {DEPTH: b"bvx2garbage"}}, {"members": {DEPTH: lzfse.compress(bytes(3072))[:9]}}],
    "CAP-020": [
        {"members": {"rgbd/3.jpg": b"\xff\xd8\xff nothing"}},
        {"members": {"rgbd/3.jpg": b""}},
        {"members": {"rgbd/3.jpg": huge_jpeg()}},
    ],
    "CAP-002": [
        {"members": {"../escape": b"x"}},
        {"members": {"/etc/x": b"x"}},
        {"members": {"a\\b": b"x"}},
        {"members": {"bomb": bytes(10**8)}},
    ],
}


@pytest.mark.parametrize(
    ("code", "change"), [(code, change) for code, changes in CASES.items() for change in changes]
)
def test_faulty_recordings_are_refused(tmp_path, monkeypatch, capsys, code, change):
    made = walk(12)
    made.metadata |= change.get("metadata", {})
    made.members |= change.get("members", {})
    assert code in _refused(made.write(tmp_path / "a.r3d"), tmp_path, monkeypatch, capsys)


@pytest.mark.parametrize("share", [0.0, 0.3, 0.98])
def test_truncated_file_is_refused(tmp_path, monkeypatch, capsys, share):
    path = walk(12).write(tmp_path / "a.r3d")
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    assert "CAP-001" in _refused(path, tmp_path, monkeypatch, capsys)


def test_flipped_bytes_are_refused(tmp_path, monkeypatch, capsys):
    path = walk(12).write(tmp_path / "a.r3d")
    data = bytearray(path.read_bytes())
    at = data.find(b"rgbd/3.jpg") + 60
    data[at : at + 8] = bytes(8)
    path.write_bytes(data)
    assert "CAP-001" in _refused(path, tmp_path, monkeypatch, capsys)


@pytest.mark.parametrize("frames", [1, 5])
def test_too_short_recording_is_refused(tmp_path, monkeypatch, capsys, frames):
    message = _refused(walk(frames).write(tmp_path / "a.r3d"), tmp_path, monkeypatch, capsys)
    assert "CAP-007" in message
    assert "record some seconds" in message


def test_mostly_damaged_video_is_refused(tmp_path):
    with pytest.raises(InputError, match="CAP-001.*3 of 4 pictures"):
        writing.write_frames(tmp_path, [None] * 3, Config(), total=4, where="a.mp4")


def test_symbolic_link_in_an_archive_is_refused(tmp_path, monkeypatch, capsys):
    path = walk(12).write(tmp_path / "a.r3d")
    with zipfile.ZipFile(path, "a") as archive:
        link = zipfile.ZipInfo("rgbd/99.jpg")
        link.external_attr = 0o120777 << 16
        archive.writestr(link, "/etc/passwd")
    assert "CAP-002" in _refused(path, tmp_path, monkeypatch, capsys)


def test_unknown_formats_are_refused(tmp_path, monkeypatch, capsys):
    (tmp_path / "folder").mkdir()
    assert "CAP-003" in _refused(tmp_path / "folder", tmp_path, monkeypatch, capsys)
    write_zip(tmp_path / "b.r3d", {"hello": b"world"})
    assert "CAP-003" in _refused(tmp_path / "b.r3d", tmp_path, monkeypatch, capsys)


@pytest.mark.parametrize("size", [0, 3, 100, 50_000, 1_000_000])
def test_lzfse_headers_give_the_decoded_size(size):
    rng = np.random.default_rng(size)
    for data in (bytes(size), rng.bytes(size), rng.integers(0, 4, size, dtype=np.uint8).tobytes()):
        assert record3d.unpacked_bytes(lzfse.compress(data)) == size


def test_empty_lzfse_blocks_are_refused():
    with pytest.raises(ValueError, match="empty block"):
        record3d.unpacked_bytes(b"bvx2" + struct.pack("<I3Q", 0, 0, 0, 0) + bytes(100))
