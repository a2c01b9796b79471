"""Small text files beside pictures: tables of numbers, times, and the cameras of formats without metadata."""

from bisect import bisect_left

import numpy as np
from jaxtyping import Bool, Float

from pipeline.core.errors import InputError
from pipeline.geometry import cameras
from pipeline.recordings import errors
from pipeline.recordings.containers import Container
from pipeline.recordings.recording import DepthCamera, intrinsics_from_coefficients, pose_from_matrix

INTRINSICS = ("intrinsics.txt", "camera-intrinsics.txt", "camera_matrix.csv")
"""3 x 3 or 4 x 4 matrix, or the four numbers fx fy cx cy, in color pixels"""
DEPTH_INTRINSICS, DEPTH_FROM_COLOR = "depth_intrinsics.txt", "depth_from_color.txt"
"""intrinsics of a separate depth camera, in depth pixels, and its extrinsics: a 4 x 4 matrix, meters"""
MAX_BASELINE_M = 0.5
"""largest distance of two cameras of one handheld device"""
MIN_TIMED = 0.5
"""minimum share of frames with increasing times"""
TIME_UNITS = {1.0: "seconds", 1e3: "milliseconds", 1e6: "microseconds", 1e9: "nanoseconds"}
LONGEST_STEP_S = 8.0
"""units per second, and longest typical step: RGB-D cameras take at most 125 pictures per second"""


def lines(container: Container, name: str) -> list[str]:
    """Return a member's lines without comments and blank lines."""
    found = map(str.strip, container.text(name).splitlines())
    return [line for line in found if line and not line.startswith("#")]


def table(
    container: Container, name: str, columns: int, rows: int | None = None
) -> Float[np.ndarray, "row column"]:
    """Read numbers in columns separated by blanks or commas; raises CAP-004 for anything else.

    ``-1.#IND``, as old Windows programs write it, is NaN.
    """
    cells = [line.replace(",", " ").split() for line in lines(container, name)]
    try:
        numbers = [[float("nan" if ".#" in cell else cell) for cell in row] for row in cells]
        read = np.array(numbers).reshape(len(cells), columns)
    except ValueError as error:
        why = f"not a table of {columns} columns of numbers (with decimal points)"
        raise errors.broken_metadata(container.place(name), why) from error
    if rows is not None and len(read) != rows:
        raise errors.broken_metadata(container.place(name), f"{len(read)} rows instead of {rows}")
    return read


def increasing(times: Float[np.ndarray, "frame"], where: str) -> Bool[np.ndarray, "frame"]:
    """Return the longest increasing sequence of times, so that one that jumps costs its frame alone.

    Raises CAP-004 if it has less than half of them.
    """
    ends: list[float] = []  # lowest last time of the sequences of each length
    length = np.zeros(len(times), int)
    for row in np.flatnonzero(np.isfinite(times)).tolist():
        shorter = bisect_left(ends, times[row])
        if ends[shorter : shorter + 1] != [times[row]]:
            ends[shorter : shorter + 1] = [times[row]]
            length[row] = shorter + 1
    if len(ends) < MIN_TIMED * len(times):
        raise errors.broken_metadata(where, "the times must increase")
    found, wanted, following = np.zeros(len(times), bool), len(ends), np.inf
    for row in reversed(range(len(times))):
        if 0 < length[row] == wanted and times[row] < following:
            found[row], wanted, following = True, wanted - 1, times[row]
    return found


def units_per_second(times: Float[np.ndarray, "frame"]) -> tuple[float, tuple[str, ...]]:
    """Return the unit of increasing times by their typical step, and a remark unless these are seconds."""
    step = float(np.median(np.diff(times, prepend=times[0])))
    per_second = next((each for each in TIME_UNITS if step <= LONGEST_STEP_S * each), max(TIME_UNITS))
    remark = f"time stamps seem to be {TIME_UNITS[per_second]}, and are read as such"
    return per_second, () if per_second == 1 else (remark,)


def read_intrinsics(
    container: Container, frames: int, default: tuple[float, ...] | None
) -> tuple[Float[np.ndarray, "frame 3 3"], tuple[str, ...]]:
    """Return the intrinsics of all frames, from a file beside the pictures, or the default and a remark.

    ``default`` is (fx, fy, cx, cy). Raises CAP-011 without either.
    """
    name, remarks = next((name for name in INTRINSICS if name in container.names), None), ()
    if name is not None:
        coefficients = read_coefficients(container, name)
    elif default is not None:
        coefficients, (fx, _, cx, cy) = np.array(default), default
        remarks = (f"no intrinsics.txt: the default fx {fx:g}, cx {cx:g}, cy {cy:g} is assumed",)
    else:
        remedy = "write intrinsics.txt with the four numbers fx fy cx cy, in color pixels"
        what = "the focal length of these pictures is unknown"
        raise InputError("CAP-011", what, container.where, remedy)
    return intrinsics_from_coefficients(np.tile(coefficients, (frames, 1)), container.where), remarks


def read_coefficients(container: Container, name: str) -> Float[np.ndarray, "4"]:
    """Read (fx, fy, cx, cy) from a file with these four numbers or a matrix. Raises CAP-004."""
    try:
        numbers = np.array(
            [float(cell) for cell in " ".join(lines(container, name)).replace(",", " ").split()]
        )
    except ValueError as error:
        raise errors.broken_metadata(container.place(name), "it holds more than numbers") from error
    if len(numbers) == 4:
        return numbers
    if len(numbers) in (9, 16):
        side = 3 if len(numbers) == 9 else 4
        return numbers.reshape(side, side)[[0, 1, 0, 1], [0, 1, 2, 2]]
    why = f"{len(numbers)} numbers are neither fx fy cx cy nor a matrix (use decimal points)"
    raise errors.broken_metadata(container.place(name), why)


def depth_camera(
    container: Container,
    color_intrinsics: Float[np.ndarray, "3 3"],
    sizes: tuple[tuple[int, int], tuple[int, int]],
) -> tuple[DepthCamera | None, tuple[str, ...]]:
    """Return the depth camera of `depth_intrinsics.txt` and `depth_from_color.txt`, if any, and a remark.

    ``sizes`` are (height, width) of color and of depth as stored. Without the latter file the cameras have
    the same pose, without the former the same lens. Raises CAP-004 for a matrix that is not a rigid motion
    or moves too far.
    """
    color_size, depth_size = sizes
    if not {DEPTH_INTRINSICS, DEPTH_FROM_COLOR} & container.names:
        return None, ()
    intrinsics = cameras.scale_intrinsics(color_intrinsics, color_size, depth_size)
    if DEPTH_INTRINSICS in container.names:
        numbers = read_coefficients(container, DEPTH_INTRINSICS)[None]
        intrinsics = intrinsics_from_coefficients(numbers, container.place(DEPTH_INTRINSICS))[0]
    depth_from_color, place = np.eye(4), container.place(DEPTH_FROM_COLOR)
    if DEPTH_FROM_COLOR in container.names:
        depth_from_color = table(container, DEPTH_FROM_COLOR, 4, rows=4)
    found = possible(DepthCamera(intrinsics, depth_from_color), place)
    return found, (depth_camera_remark(found, color_intrinsics),)


def possible(camera: DepthCamera, where: str) -> DepthCamera:
    """Return a camera. Raises CAP-004 if its matrix is not a rigid motion or moves too far."""
    if not np.isfinite(pose_from_matrix(camera.depth_from_color[None])).all():
        why = "it is no rigid motion: rotation and translation in meters, four rows"
        raise errors.broken_metadata(where, why)
    apart_m = np.linalg.norm(camera.depth_from_color[:3, 3])
    if apart_m > MAX_BASELINE_M:
        what = f"its cameras are {apart_m:g} m apart, further than in one device"
        raise InputError("CAP-004", what, where, "write its last column in meters")
    return camera


def depth_camera_remark(camera: DepthCamera, color_intrinsics: Float[np.ndarray, "3 3"]) -> str:
    """Describe the two cameras, for capture-check and the log."""
    depth_fx, color_fx = camera.intrinsics[0, 0], color_intrinsics[0, 0]
    apart_mm = 1000 * np.linalg.norm(camera.depth_from_color[:3, 3])
    apart = f"{apart_mm:.0f} mm from the color camera (fx {color_fx:g})"
    return f"depth camera fx {depth_fx:g}, {apart}: depth is reprojected"
