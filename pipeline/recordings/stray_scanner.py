"""Stray Scanner: a folder with `rgb.mp4`, `odometry.csv` and per frame depth and confidence, in landscape.

Timestamps are the odometry's (the video's are synthetic); focal lengths are per frame if available.
"""

import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int, UInt8

from pipeline.core.errors import InputError
from pipeline.recordings import errors, text_files
from pipeline.recordings.containers import FolderContainer
from pipeline.recordings.movies import Movie
from pipeline.recordings.recording import Y_UP, Recording, intrinsics_from_coefficients

INTRINSICS_SIZE = (1440, 1920)
"""(height, width) that the app's intrinsics refer to, whatever the video's size"""
POSE = ("qx", "qy", "qz", "qw", "x", "y", "z")
MAX_FRAMES = 1 << 31
"""upper bound of frame numbers"""
COEFFICIENTS = ("fx", "fy", "cx", "cy")
READ = {"timestamp", "frame", *POSE, *COEFFICIENTS}
OLDEST = ("x", "y", "z", "qx", "qy", "qz", "qw")
"""columns of the oldest app version, which wrote no header"""


@dataclass(frozen=True)
class OdometryTable:
    """The rows of `odometry.csv`."""

    frame: Int[np.ndarray, "row"]
    timestamp_s: Float[np.ndarray, "row"] | None
    pose: Float[np.ndarray, "row 7"]
    """quaternion xyzw, translation; OpenCV axes, camera to world"""
    coefficients: Float[np.ndarray, "row 4"] | None
    """fx, fy, cx, cy, if the app wrote them"""


def open_recording(path: Path) -> Recording:
    """Open a Stray Scanner folder. Raises InputError CAP-001..009 for unusable recordings."""
    container = FolderContainer(path)
    movie = Movie(container.path("rgb.mp4"))
    rows = read_odometry(container.text("odometry.csv"), container.place("odometry.csv"))
    depth = container.numbered("depth")
    if not depth:
        raise errors.no_depth(container.where, "depth/ holds no numbered pictures (links are not followed)")
    errors.refuse_numbers_from_1(depth, len(movie), "depth/", container.where)
    errors.refuse_numbers_from_1(rows.frame.tolist(), len(movie), "odometry.csv", container.where)
    complete = depth.keys() & set(movie.complete.tolist())
    valid = np.array([int(number) in complete for number in rows.frame], bool)
    if not valid.any():
        raise errors.no_frames(container.where, "none has color, depth and odometry")
    index = rows.frame[valid]
    timestamp_s = movie.timestamp_s[index] if rows.timestamp_s is None else rows.timestamp_s[valid]
    per_second, unit_remarks = text_files.units_per_second(timestamp_s)
    size = _depth(container, depth[int(index[0])], None).shape
    some = [_depth(container, depth[int(number)], None) for number in index[:: max(1, len(index) // 5)]]
    if all(np.ptp(picture, axis=1).max() == 0 and np.ptp(picture) > 0 for picture in some):
        what = "every row of the depth pictures holds one value: a fault of this version of Stray Scanner"
        remedy = "update the app and record again; the depth of this recording is lost"
        raise InputError("CAP-009", what, container.where, remedy)
    confidence = container.numbered("confidence")

    def confident(number: int) -> UInt8[np.ndarray, "height width"] | None:
        return container.gray(confidence[number]) if number in confidence else None

    return Recording(
        where=container.where,
        kind="Stray Scanner",
        index=index,
        timestamp_s=(timestamp_s - timestamp_s[0]) / per_second,
        intrinsics=_intrinsics(container, rows, valid, movie.size),
        pose=rows.pose[valid],
        color_size=movie.size,
        depth_size=size,
        read_color=movie.read,
        read_depth=lambda i: _depth(container, depth[i], size),
        read_confidence=confident if confidence else None,
        up=Y_UP,
        remarks=movie.remarks + unit_remarks,
        listed=max(len(movie), len(rows.frame)),
    )


def read_odometry(text: str, where: str) -> OdometryTable:
    """Read the table by its column names: 7 (oldest, no header), 9 or 15 columns, blanks where unknown.

    Rows whose times do not increase, and a last one that was cut off, are left out.
    """
    lines = [[cell.strip() for cell in row.split(",")] for row in text.splitlines()]
    lines = [row for row in lines if any(row)]
    header = tuple(cell.lower() for cell in lines[0]) if lines else ()
    if {"timestamp", *POSE} <= set(header):
        lines = lines[1:]
    elif len(header) != len(OLDEST):
        raise errors.broken_metadata(where, f"columns {', '.join(header) or 'none'} are no odometry")
    else:
        header = OLDEST
    lines = lines[: len(lines) - (len(lines) > 1 and len(lines[-1]) < len(lines[0]))]
    known = [(i, name) for i, name in enumerate(header) if name in READ]
    try:
        column = {name: np.array([float(row[i] or "nan") for row in lines]) for i, name in known}
    except (ValueError, IndexError) as error:
        raise errors.broken_metadata(where, f"a row is cut or no numbers ({error})") from error
    timestamp_s = column.get("timestamp", np.arange(len(lines), dtype=float))
    timed = text_files.increasing(timestamp_s, where)
    column = {name: values[timed] for name, values in column.items()}
    frame = column.get("frame", np.flatnonzero(timed))
    if not (np.isfinite(frame) & (frame >= 0) & (frame < MAX_FRAMES)).all():
        raise errors.broken_metadata(where, "a frame has no number")
    pose, coefficients = np.stack([column[name] for name in POSE], axis=1), None
    if set(COEFFICIENTS) <= set(column):
        coefficients = np.stack([column[name] for name in COEFFICIENTS], axis=1)
        coefficients = coefficients if np.isfinite(coefficients).all() else None
    return OdometryTable(frame.astype(int), column.get("timestamp"), pose, coefficients)


def _intrinsics(
    container: FolderContainer, rows: OdometryTable, valid: np.ndarray, size: tuple[int, int]
) -> Float[np.ndarray, "frame 3 3"]:
    """Return intrinsics in the video's pixels: per frame, else the last frame's of `camera_matrix.csv`."""
    if rows.coefficients is not None:
        coefficients = rows.coefficients[valid]
    else:
        coefficients = text_files.read_coefficients(container, "camera_matrix.csv")
        coefficients = np.tile(coefficients, (int(valid.sum()), 1))
    height, width = (size[0] / INTRINSICS_SIZE[0], size[1] / INTRINSICS_SIZE[1])
    return intrinsics_from_coefficients(coefficients * [width, height, width, height], container.where)


def _depth(
    container: FolderContainer, name: str, size: tuple[int, int] | None
) -> Float[np.ndarray, "height width"]:
    """Read uint16 millimeters from PNG, or `.npy` of older apps, as meters. Raises CAP-008."""
    if not name.endswith(".npy"):
        return container.meters(name, size)
    try:
        raw = np.load(io.BytesIO(container.read(name)), allow_pickle=False)
    except (ValueError, EOFError, OSError) as error:
        raise errors.wrong_depth(container.place(name), str(error)) from error
    if raw.ndim != 2 or raw.dtype != np.uint16:
        raise errors.wrong_depth(container.place(name), f"{raw.dtype} {raw.shape}")
    errors.refuse_other_size(raw.shape, size, container.place(name))
    return raw.astype(np.float32) / np.float32(1000)
