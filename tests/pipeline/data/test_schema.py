"""Artifact tables round-trip; any damage of their bytes gives an error with a code."""

import contextlib
import io
import struct
import zipfile

import numpy as np
import pytest

from pipeline.core.errors import InputError
from pipeline.data import npz
from pipeline.data.poses import RegisteredPoses
from pipeline.data.schema import FileSchema
from pipeline.data.templates import AgentCameras, SceneCameras

SCHEMA = FileSchema.of("made/table.npz", "time_s [frame] f8", "place [frame 3] f4", "name [] U?")


def poses(frames: int) -> np.ndarray:
    return np.repeat(np.eye(4)[None], frames, axis=0)


def test_table_round_trips_in_the_dtypes_of_its_schema(tmp_path):
    SCHEMA.save(tmp_path / "table.npz", time_s=np.arange(3), place=np.ones((3, 3)), name=None)
    table = SCHEMA.load(tmp_path / "table.npz")
    assert {key: array.dtype.str for key, array in table.items()} == {"time_s": "<f8", "place": "<f4"}
    SCHEMA.save(tmp_path / "table.npz", time_s=np.arange(3), place=np.ones((3, 3)), name=np.array("cat"))
    assert str(SCHEMA.load(tmp_path / "table.npz", "name")["name"]) == "cat"


@pytest.mark.parametrize(
    "arrays",
    [
        {"time_s": np.arange(3.0)},
        {"time_s": np.arange(3.0), "place": np.ones((2, 3), "f4")},
        {"time_s": np.arange(3.0), "place": np.ones((3, 2), "f4")},
        {"time_s": np.arange(3.0), "place": np.ones(3, "f4")},
        {"time_s": np.array(["a", "b", "c"]), "place": np.ones((3, 3), "f4")},
    ],
    ids=["missing", "lengths", "width", "axes", "kind"],
)
def test_table_of_another_schema_is_refused(tmp_path, arrays):
    npz.save(tmp_path / "table.npz", **arrays)
    with pytest.raises(InputError, match="ART-010"):
        SCHEMA.load(tmp_path / "table.npz")


def test_frames_without_registration_have_no_pose(tmp_path):
    registered, keyframe = np.array([True, False, True]), np.array([False, True, True])
    intrinsics = np.repeat(np.eye(3)[None], 3, axis=0)
    SceneCameras(np.arange(3.0), poses(3), intrinsics, registered, keyframe).write(tmp_path)
    cameras = SceneCameras.open(tmp_path)
    assert (np.isfinite(cameras.world_from_registered).all((1, 2)) == registered).all()
    assert (np.isfinite(cameras.world_from_keyframe).all((1, 2)) == (registered & keyframe)).all()
    assert np.isfinite(cameras.world_from_camera).all()
    AgentCameras(np.arange(3.0), poses(3), intrinsics, registered).write(tmp_path)
    assert (np.isnan(AgentCameras.open(tmp_path).agent_from_registered).all((1, 2)) == ~registered).all()
    assert RegisteredPoses.open(tmp_path) is None, "a recording that was refused has no poses"


def _member(array_header: bytes, payload: bytes = b"") -> bytes:
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(array_header)) + array_header + payload


def _archive(name: str, data: bytes, method: int = zipfile.ZIP_STORED) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", method) as archive:
        archive.writestr(name, data)
    return stream.getvalue()


HUGE = b"{'descr': '<f8', 'fortran_order': False, 'shape': (7500000000,), }\n"
NEGATIVE = b"{'descr': '<f8', 'fortran_order': False, 'shape': (-1, -8), }\n"


def _encrypted() -> bytes:
    data = bytearray(_archive("time_s.npy", _member(HUGE)))
    data[6] |= 1
    data[data.index(b"PK\x01\x02") + 8] |= 1
    return bytes(data)


@pytest.mark.parametrize(
    "data",
    [
        _archive("readme.txt", b"hello"),
        _archive("time_s.npy", _member(HUGE, b"\0" * 80)),
        _archive("time_s.npy", _member(NEGATIVE, b"\0" * 80)),
        _archive("time_s.npy", b"\x93NUMPY\x01\x00\x10\x00" + b"(" * 16),
        _archive("time_s.npy", b""),
        _encrypted(),
        _archive("time_s.npy", _member(HUGE), zipfile.ZIP_LZMA).replace(b"\x5d\x00\x00", b"\xff\xff\xff"),
        b"PK\x03\x04 no archive",
    ],
    ids=["foreign", "56 GiB", "negative", "header", "empty", "encrypted", "lzma", "no archive"],
)
def test_damaged_archive_gives_an_error_code(tmp_path, data):
    (tmp_path / "table.npz").write_bytes(data)
    for read in (
        SCHEMA.load,
        lambda path: npz.load(path, ("time_s",)),
        lambda path: npz.open_lazily(path, "time_s"),
    ):
        with pytest.raises(InputError, match="ART-010"):
            read(tmp_path / "table.npz")


def test_flipped_bytes_give_the_arrays_or_an_error_code(tmp_path):
    path = tmp_path / "table.npz"
    SCHEMA.save(path, time_s=np.arange(50.0), place=np.ones((50, 3)), compress=True)
    whole, rng = path.read_bytes(), np.random.default_rng(0)
    for _ in range(300):
        data = bytearray(whole)
        data[rng.integers(len(data))] ^= 1 << rng.integers(8)
        path.write_bytes(data)
        with contextlib.suppress(InputError):
            assert (SCHEMA.load(path)["time_s"] == np.arange(50.0)).all()
