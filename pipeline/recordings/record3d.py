"""Record3D's two exports: an ``.r3d`` archive, or a folder of EXR and JPEG files.

Files are matched with rows of the metadata by number, so that missing ones do not shift the others.
"""

import math
import struct
from dataclasses import dataclass
from pathlib import Path

import lzfse
import numpy as np
from jaxtyping import Bool, Float, Int

from pipeline.core.errors import InputError
from pipeline.data import images
from pipeline.recordings import errors, text_files
from pipeline.recordings.containers import Container, FolderContainer, ZipContainer, frame_number
from pipeline.recordings.conventions import OPENGL
from pipeline.recordings.recording import Y_UP, Recording, intrinsics_from_coefficients

DEPTH_SIZES = {49_152: (256, 192), 307_200: (640, 480), 691_200: (960, 720)}
"""floats per picture -> (height, width) of a portrait recording, if the metadata lack it"""
FACE_ID_FLOATS = (307_200, 691_200)
FACE_ID, LIDAR = 0, 1
"""the app's numbers of the front and back cameras"""
MAX_SIDE_PX = 16384
"""maximum longer side of a phone's picture"""
LZFSE_HEADER_BYTES = {b"bvxn": 12, b"bvx1": 772}
"""header size by magic number: LZVN blocks, and LZFSE v1 blocks (uncompressed tables)"""
LZFSE_FIELD_BITS = 20
"""bits per field in the packed header of LZFSE v2 blocks"""
LZFSE_END = b"bvx$"
"""end of stream marker of LZFSE"""


@dataclass(frozen=True)
class _Layout:
    """Paths of an export's members; ``%d`` is the frame number."""

    metadata: str
    color: str
    depth: str


_ARCHIVE = _Layout("metadata", "rgbd/%d.jpg", "rgbd/%d.depth")
_FOLDER = _Layout("metadata.json", "rgb/%d.jpg", "depth/%d.exr")
_CONFIDENCE = "rgbd/%d.conf"


def open_recording(path: Path) -> Recording:
    """Open a ``.r3d`` file, or a folder that is or holds Record3D's ``EXR_RGBD``.

    Raises InputError CAP-001..008 for unusable recordings.
    """
    if path.is_dir():
        inner = path / "EXR_RGBD"
        return _open(FolderContainer(inner if inner.is_dir() else path), _FOLDER)
    return _open(ZipContainer(path), _ARCHIVE)


def _open(container: Container, layout: _Layout) -> Recording:
    if layout.metadata not in container.names:
        what = f"not a Record3D recording: it has no {layout.metadata!r}"
        remedy = "export from Record3D as 'Shareable/Internal format (.r3d)' or 'EXR + JPG sequence'"
        raise InputError("CAP-003", what, container.where, remedy)
    metadata = _Metadata(container, layout.metadata)
    container.refuse_surplus_members(metadata.declared_frames())
    stored, pictures = (_numbers(container.names, each) for each in (layout.depth, layout.color))
    if not stored:
        raise errors.no_depth(container.where, "Record3D's archive holds none")
    index = np.array(sorted(stored & pictures), int)
    if len(index) == 0:
        raise errors.no_frames(container.where, "none has color and depth")
    errors.refuse_numbers_from_1(stored, metadata.declared_frames(), "each file", container.where)
    timestamp_s = metadata.timestamp_s(index)
    index, timestamp_s = index[np.isfinite(timestamp_s)], timestamp_s[np.isfinite(timestamp_s)]
    intrinsics, pose = metadata.intrinsics(index), metadata.pose(index)
    depth_size = _depth_size(container, layout, metadata, int(index[0]))
    if metadata.camera_type() == FACE_ID or math.prod(depth_size) in FACE_ID_FLOATS:
        what = "recorded with the Face-ID camera: it has no device poses"
        remedy = "record with the LiDAR camera at the back of the phone"
        raise InputError("CAP-005", what, container.where, remedy)
    confident = _numbers(container.names, _CONFIDENCE)

    def confidence(frame: int) -> np.ndarray | None:
        if frame not in confident:
            return None
        data = _decompress_exactly(container, _CONFIDENCE % frame, math.prod(depth_size))
        return np.frombuffer(data, np.uint8).reshape(depth_size)

    return Recording(
        where=container.where,
        kind="Record3D .r3d" if layout is _ARCHIVE else "Record3D EXR + JPG",
        index=index,
        timestamp_s=timestamp_s,
        intrinsics=intrinsics,
        pose=pose,
        color_size=metadata.color_size,
        depth_size=depth_size,
        read_color=lambda i: container.read(layout.color % i),
        read_depth=lambda i: _read_depth(container, layout.depth % i, depth_size),
        read_confidence=None if confident.isdisjoint(index) else confidence,
        convention=OPENGL,
        up=metadata.up(),
        remarks=tuple(metadata.remarks),
        listed=max(metadata.declared_frames(), len(stored | pictures)),
    )


class _Metadata:
    """The recording's JSON, validated when read, with rows by frame number. Errors are CAP-004.

    Values missing in single rows are replaced or dropped, and counted in ``remarks``.
    """

    def __init__(self, container: Container, name: str) -> None:
        self.remarks: list[str] = []
        self._where, self._table = container.place(name), container.table(name)
        self.color_size = (self._pixels("h"), self._pixels("w"))

    def declared_frames(self) -> int:
        """Return the number of frames by the metadata, the maximum if tables disagree."""
        tables = (self._table.get(key) for key in ("poses", "frameTimestamps", "perFrameIntrinsicCoeffs"))
        return max((len(table) for table in tables if isinstance(table, list)), default=0)

    def depth_size(self) -> tuple[int, int] | None:
        """Return (height, width) of the depth pictures, if the app wrote it."""
        return (self._pixels("dh"), self._pixels("dw")) if {"dh", "dw"} <= self._table.keys() else None

    def timestamp_s(self, index: Int[np.ndarray, "frame"]) -> Float[np.ndarray, "frame"]:
        """Return seconds since the first frame, NaN where not increasing; old apps wrote only the rate."""
        if not self._table.get("frameTimestamps"):
            return (index - index[0]) / self._numbers("fps", (), positive=True)
        timestamp_s = self._rows("frameTimestamps", (), index)
        good = text_files.increasing(timestamp_s, self._where)
        self._remark(~good, "are left out: their times are missing or do not increase")
        per_second, unit_remarks = text_files.units_per_second(timestamp_s[good])
        self.remarks += unit_remarks
        return np.where(good, (timestamp_s - timestamp_s[good][0]) / per_second, np.nan)

    def intrinsics(self, index: Int[np.ndarray, "frame"]) -> Float[np.ndarray, "frame 3 3"]:
        """Return K in color pixels, per frame if the app wrote it, else the first frame's."""
        coefficients = self._rows("perFrameIntrinsicCoeffs", (4,), index)
        missing = ~(np.all(np.isfinite(coefficients), axis=1) & np.all(coefficients[:, :2] > 0, axis=1))
        if missing.any():
            first = self._numbers("K", (9,)).reshape(3, 3).T  # stored column-major
            coefficients[missing] = first[[0, 1, 0, 1], [0, 1, 2, 2]]
            if self._table.get("perFrameIntrinsicCoeffs"):
                self._remark(missing, "have no intrinsics of their own: the first frame's are used")
        return intrinsics_from_coefficients(coefficients, self._where)

    def camera_type(self) -> int | None:
        """Return the app's number of the camera, if it wrote one."""
        if "cameraType" not in self._table:
            return None
        camera_type = int(self._numbers("cameraType", ()))
        if camera_type not in (FACE_ID, LIDAR):
            self.remarks.append(f"camera type {camera_type} is not known: it is read like the LiDAR camera")
        return camera_type

    def pose(self, index: Int[np.ndarray, "frame"]) -> Float[np.ndarray, "frame 7"] | None:
        """Return the device poses as stored, NaN where missing or not numeric; None without any."""
        if not self._table.get("poses"):
            return None
        pose = self._rows("poses", (7,), index)
        self._remark(~np.all(np.isfinite(pose), axis=1), "have no device pose")
        return pose

    def up(self) -> tuple[float, float, float] | None:
        """Return the up direction in the poses' world; None for old apps, whose world is the first camera."""
        first = self._rows("poses", (7,), np.zeros(1, int))
        return None if np.isnan(first).all() or np.allclose(first, (0, 0, 0, 1, 0, 0, 0), atol=1e-6) else Y_UP

    def _rows(self, key: str, shape: tuple[int, ...], index: Int[np.ndarray, "frame"]) -> np.ndarray:
        """Read rows of the given shape by frame number; NaN where missing or not numeric."""
        rows = np.full((len(index), *shape), np.nan)
        if self._table.get(key):
            stored = self._numbers(key, (None, *shape), finite=False)
            rows[index < len(stored)] = stored[index[index < len(stored)]]
        return np.where(np.isfinite(rows), rows, np.nan)

    def _remark(self, frames: Bool[np.ndarray, "frame"], what: str) -> None:
        if frames.any():
            self.remarks.append(f"{frames.sum()} of {len(frames)} frames {what}")

    def _pixels(self, key: str) -> int:
        value = float(self._numbers(key, (), positive=True))
        if value > MAX_SIDE_PX or value != int(value):
            raise self._broken(f"{key!r} is no picture size: {value:g}")
        return int(value)

    def _numbers(
        self, key: str, shape: tuple[int | None, ...], *, positive: bool = False, finite: bool = True
    ) -> np.ndarray:
        """Read an array of numbers with the given shape (None: any length)."""
        if key not in self._table:
            raise self._broken(f"{key!r} is missing")
        try:
            array = np.array(self._table[key], float)
            if any(want not in (None, have) for want, have in zip(shape, array.shape, strict=True)):
                raise ValueError(array.shape)
        except (TypeError, ValueError, OverflowError) as error:
            raise self._broken(f"{key!r} has the wrong form") from error
        if (finite and not np.isfinite(array).all()) or (positive and np.any(array <= 0)):
            raise self._broken(f"{key!r} holds impossible values")
        return array

    def _broken(self, why: str) -> InputError:
        return errors.broken_metadata(self._where, why)


def _numbers(names: frozenset[str], pattern: str) -> set[int]:
    """Return the frame numbers of members that match a pattern such as ``rgbd/%d.jpg``."""
    numbers = (frame_number(Path(name).stem) for name in names)
    return {number for number in numbers if number is not None and pattern % number in names}


def _depth_size(container: Container, layout: _Layout, metadata: _Metadata, first: int) -> tuple[int, int]:
    """Return (height, width) of depth: from the metadata, else from the first picture."""
    size = metadata.depth_size()
    if size is not None:
        return size
    name = layout.depth % first
    if layout is _FOLDER and isinstance(container, FolderContainer):
        height, width = images.read_depth(container.path(name), channel="R").shape
        return height, width
    floats = len(_decompress(container, name, 4 * max(DEPTH_SIZES))) // 4
    if floats not in DEPTH_SIZES:
        raise errors.wrong_depth(container.place(name), f"{floats} values fit no known depth camera")
    height, width = DEPTH_SIZES[floats]  # upright
    return (height, width) if metadata.color_size[0] >= metadata.color_size[1] else (width, height)


def _read_depth(container: Container, name: str, size: tuple[int, int]) -> Float[np.ndarray, "height width"]:
    if isinstance(container, FolderContainer):
        depth = images.read_depth(container.path(name), channel="R")
    else:
        depth = np.frombuffer(_decompress_exactly(container, name, 4 * math.prod(size)), "<f4").reshape(size)
    errors.refuse_other_size(depth.shape, size, container.place(name))
    return depth


def _decompress_exactly(container: Container, name: str, expected: int) -> bytes:
    data = _decompress(container, name, expected)
    if len(data) != expected:
        raise errors.wrong_depth(container.place(name), f"{len(data)} bytes instead of {expected}")
    return data


def _decompress(container: Container, name: str, max_bytes: int) -> bytes:
    """Decompress LZFSE after checking that its block headers declare at most ``max_bytes``."""
    where = container.place(name)
    packed = container.read(name, max_bytes + max_bytes // 8 + 4096)
    try:
        if unpacked_bytes(packed) > max_bytes:
            raise errors.wrong_depth(where, f"more than {max_bytes} bytes")
        return lzfse.decompress(packed)
    except (lzfse.error, MemoryError, ValueError) as error:
        raise errors.damaged(where, f"LZFSE: {error}") from error


def unpacked_bytes(data: bytes) -> int:
    """Sum the uncompressed sizes in the block headers. Raises ValueError for a cut or other stream."""
    at, total = 0, 0
    while data[at : at + 4] != LZFSE_END:
        raw, length = _block(data, at)
        if length < 8:
            raise ValueError("empty block")
        at, total = at + length, total + raw
    return total


def _block(data: bytes, at: int) -> tuple[int, int]:
    """Return (uncompressed bytes, stored bytes with header) of the block at an offset."""
    try:
        match data[at : at + 4]:
            case b"bvx-":
                (raw,) = struct.unpack_from("<I", data, at + 4)
                return raw, 8 + raw
            case b"bvxn" | b"bvx1" as kind:
                raw, payload = struct.unpack_from("<2I", data, at + 4)
                return raw, LZFSE_HEADER_BYTES[kind] + payload
            case b"bvx2":
                raw, first, second, third = struct.unpack_from("<I3Q", data, at + 4)
                literals = first >> LZFSE_FIELD_BITS & 0xFFFFF
                matches = second >> 2 * LZFSE_FIELD_BITS & 0xFFFFF
                return raw, (third & 0xFFFFFFFF) + literals + matches
    except struct.error as error:
        raise ValueError("cut short") from error
    raise ValueError("unknown block" if data[at : at + 4] else "cut short")
