"""Stray Scanner: a folder with `rgb.mp4`, one depth and confidence PNG per frame and `odometry.csv`, as
stored in sensor landscape.

Times are the odometry's (the video's are counted, not real); focal lengths per frame where the app wrote
them.
"""

import csv
import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from pipeline.core.errors import InputError
from pipeline.recordings.containers import FolderContainer, frame_number
from pipeline.recordings.conventions import OPENCV
from pipeline.recordings.movies import Movie
from pipeline.recordings.recording import (  # fmt: skip
    MAX_PICTURE_BYTES,
    MAX_TEXT_BYTES,
    Y_UP,
    Recording,
    broken_metadata,
    decode_gray,
    intrinsics_from_coefficients,
    meters_from_png,
    no_depth,
    no_frames,
)

INTRINSICS_SIZE = (1440, 1920)
"""(height, width) to which the app's intrinsics refer, whatever the video's size"""
POSE = ("qx", "qy", "qz", "qw", "x", "y", "z")
MAX_FRAMES = 1 << 31
"""frame numbers are below this"""
COEFFICIENTS = ("fx", "fy", "cx", "cy")
OLDEST = ("x", "y", "z", "qx", "qy", "qz", "qw")
"""columns of the oldest app, which wrote no header"""


@dataclass(frozen=True)
class Odometry:
    """The rows of `odometry.csv`."""

    frame: Int[np.ndarray, "row"]
    timestamp_s: Float[np.ndarray, "row"] | None
    pose: Float[np.ndarray, "row 7"]
    """quaternion xyzw, translation; OpenCV axes, camera to world"""
    coefficients: Float[np.ndarray, "row 4"] | None
    """fx, fy, cx, cy where the app wrote them"""


def open_recording(path: Path) -> Recording:
    """Open a Stray Scanner folder. Raises InputError CAP-001..009 for what cannot be used."""
    container = FolderContainer(path)
    movie = Movie(container.regular("rgb.mp4"))
    rows = read_odometry(_text(container, "odometry.csv"), f"{path}/odometry.csv")
    depth = {
        number: name
        for name in sorted(container.names)
        if name.startswith("depth/") and (number := frame_number(Path(name).stem)) is not None
    }
    if not depth:
        raise no_depth(container.where, "the folder depth/ is empty")
    valid = np.array([number < len(movie) and int(number) in depth for number in rows.frame], bool)
    if not valid.any():
        raise no_frames(container.where, "none has colour, depth and odometry")
    index = rows.frame[valid]
    timestamp_s = movie.timestamp_s[index] if rows.timestamp_s is None else rows.timestamp_s[valid]
    size = _depth(container, depth[int(index[0])], None).shape
    _refuse_constant_rows(container, [depth[int(number)] for number in index[:: max(1, len(index) // 5)]])
    known = all(f"confidence/{int(number):06d}.png" in container.names for number in index)
    return Recording(
        where=container.where,
        kind="Stray Scanner",
        index=index,
        timestamp_s=timestamp_s - timestamp_s[0],
        intrinsics=_intrinsics(container, rows, valid, movie.size),
        pose=rows.pose[valid],
        color_size=movie.size,
        depth_size=size,
        read_color=movie.read,
        read_depth=lambda i: _depth(container, depth[i], size),
        read_confidence=(lambda i: _confidence(container, f"confidence/{i:06d}.png")) if known else None,
        convention=OPENCV,
        up=Y_UP,
    )


def read_odometry(text: str, where: str) -> Odometry:
    """Read the table by its column names.

    7 (oldest, no header), 9 or 15 columns, blanks where nothing was known.
    """
    lines = [
        [cell.strip() for cell in row]
        for row in csv.reader(text.splitlines())
        if any(cell.strip() for cell in row)
    ]
    header = tuple(lines[0]) if lines else ()
    if not set(POSE) <= set(header):
        if len(header) != len(OLDEST):
            raise broken_metadata(where, f"columns {', '.join(header) or 'none'} are no odometry")
        header = OLDEST
    else:
        lines = lines[1:]
    try:
        table = np.array(
            [[float(cell) if cell else np.nan for cell in row[: len(header)]] for row in lines]
        ).reshape(-1, len(header))
    except ValueError as error:
        raise broken_metadata(where, f"a row is cut or no numbers ({error})") from error
    column = {name: table[:, i] for i, name in enumerate(header)}
    timestamp_s = column.get("timestamp")
    if timestamp_s is not None and (not np.isfinite(timestamp_s).all() or np.any(np.diff(timestamp_s) <= 0)):
        raise broken_metadata(where, "the times must increase")
    frame = column.get("frame", np.arange(len(table)))
    if not (np.isfinite(frame) & (frame >= 0) & (frame < MAX_FRAMES)).all():
        raise broken_metadata(where, "a frame has no number")
    coefficients = (
        np.stack([column[name] for name in COEFFICIENTS], axis=1)
        if set(COEFFICIENTS) <= set(column)
        else None
    )
    if coefficients is not None and not np.isfinite(coefficients).all():
        coefficients = None
    return Odometry(
        frame.astype(int), timestamp_s, np.stack([column[name] for name in POSE], axis=1), coefficients
    )


def _intrinsics(
    container: FolderContainer, rows: Odometry, valid: np.ndarray, size: tuple[int, int]
) -> Float[np.ndarray, "frame 3 3"]:
    """Return per-frame intrinsics in the video's pixels.

    `camera_matrix.csv` (the last frame's) where the rows have none.
    """
    if rows.coefficients is not None:
        coefficients = rows.coefficients[valid]
    else:
        text = _text(container, "camera_matrix.csv")
        try:
            matrix = np.array(
                [[float(cell) for cell in line.split(",")] for line in text.splitlines() if line.strip()]
            ).reshape(3, 3)
        except ValueError as error:
            raise broken_metadata(f"{container.where}/camera_matrix.csv", "it is no 3 x 3 matrix") from error
        coefficients = np.tile(matrix[[0, 1, 0, 1], [0, 1, 2, 2]], (int(valid.sum()), 1))
    height, width = (size[0] / INTRINSICS_SIZE[0], size[1] / INTRINSICS_SIZE[1])
    return intrinsics_from_coefficients(coefficients * [width, height, width, height], container.where)


def _text(container: FolderContainer, name: str) -> str:
    if name not in container.names:
        raise broken_metadata(container.where, f"{name} is missing")
    return container.read(name, MAX_TEXT_BYTES).decode("utf-8", errors="replace")


def _depth(
    container: FolderContainer, name: str, size: tuple[int, int] | None
) -> Float[np.ndarray, "height width"]:
    where = f"{container.where}/{name}"
    if name.endswith(".npy"):
        return meters_from_npy(container.read(name, MAX_PICTURE_BYTES), size, where)
    return meters_from_png(container.read(name, MAX_PICTURE_BYTES), size, where)


def meters_from_npy(
    data: bytes, size: tuple[int, int] | None, where: str
) -> Float[np.ndarray, "height width"]:
    """Read the older app's `.npy` depth: uint16 millimetres. Raises CAP-008."""
    try:
        raw = np.load(io.BytesIO(data), allow_pickle=False)
    except (ValueError, EOFError, OSError) as error:
        raise InputError(
            "CAP-008", f"a depth picture is wrong: {error}", where, "export it from the phone again"
        ) from error
    if raw.ndim != 2 or raw.dtype != np.uint16 or (size is not None and raw.shape != size):
        raise InputError(
            "CAP-008",
            f"a depth picture is wrong: {raw.dtype} {raw.shape}",
            where,
            "export it from the phone again",
        )
    return raw.astype(np.float32) / np.float32(1000)


def _confidence(container: FolderContainer, name: str) -> np.ndarray:
    return decode_gray(container.read(name, MAX_PICTURE_BYTES), f"{container.where}/{name}", np.uint8)


def _refuse_constant_rows(container: FolderContainer, names: list[str]) -> None:
    """Refuse depth of app versions whose encoder repeated one value along each row."""
    pictures = [_depth(container, name, None) for name in names]
    if all(np.ptp(picture, axis=1).max() == 0 and np.ptp(picture) > 0 for picture in pictures):
        what = "every row of the depth pictures holds one value: a fault of this version of Stray Scanner"
        raise InputError(
            "CAP-009",
            what,
            container.where,
            "update the app and record again; the depth of this recording is lost",
        )
