"""TUM RGB-D folders: `rgb.txt`, `depth.txt` and, if present, `groundtruth.txt`, associated by timestamps.

`depth_scale.txt` holds the depth units per meter; without it, poses decide between the data set's 5000 and
millimeters. Intrinsics from `intrinsics.txt` or the data set's default.
"""

from collections.abc import Callable
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from pipeline.geometry import cameras, subsampling
from pipeline.recordings import errors, text_files
from pipeline.recordings.containers import FolderContainer
from pipeline.recordings.conventions import OPENCV, DepthPicture, check_poses
from pipeline.recordings.recording import Recording

DEFAULT_SIZE = (480, 640)
"""(height, width) that the default intrinsics refer to"""
QUOTED = 40
"""maximum characters of a line in an error"""
PER_METER, OTHERS = 5000.0, (1000.0, 10_000.0)
"""depth units per meter of the data set, and of other cameras"""
MAX_RESIDUAL_RATIO = 0.6
"""another unit is chosen if their residual is below this share of the other unit's"""
NEAREST_S = 0.02
"""maximum time difference between a color picture, its depth and its pose, seconds"""
DEFAULT = (525.0, 525.0, 319.5, 239.5)
"""fx, fy, cx, cy that the data set recommends for 640 x 480, pixels"""


def open_recording(path: Path) -> Recording:
    """Open a TUM folder. Raises InputError CAP-003..011."""
    container = FolderContainer(path)
    color, depth_files = _listed(container, "rgb.txt"), _listed(container, "depth.txt")
    if not depth_files:
        raise errors.no_depth(container.where, "depth.txt lists nothing")
    if not color:
        raise errors.no_frames(container.where, "rgb.txt lists nothing")
    ticks, depth_ticks = (np.array([time for time, _ in files]) for files in (color, depth_files))
    per_second, unit_remarks = text_files.units_per_second(ticks)
    times, depth_times = ticks / per_second, depth_ticks / per_second
    partner = partners(times, depth_times)
    nearest = subsampling.nearest(times, depth_times[partner]) == np.arange(len(times))
    paired = np.flatnonzero((partner >= 0) & nearest)  # no two color pictures have the same depth
    pairs = [(color[i][1], depth_files[partner[i]][1]) for i in paired]
    present = np.array([set(pair) <= container.names for pair in pairs], bool)
    if not present.any():
        absent = [name for pair in pairs for name in pair if name not in container.names]
        named = f"{len(absent)} of {2 * len(pairs)} listed files do not exist, e.g. {' '.join(absent[:1])}"
        why = named if absent else "no color picture has depth within 20 ms"
        raise errors.no_frames(container.where, why)
    paired, pairs = paired[present], [pair for pair, there in zip(pairs, present, strict=True) if there]
    color_size, depth_size = container.color(pairs[0][0]).shape[:2], container.meters(pairs[0][1]).shape
    default = DEFAULT if color_size == DEFAULT_SIZE else None
    intrinsics, remarks = text_files.read_intrinsics(container, len(pairs), default)
    camera, camera_remarks = text_files.depth_camera(container, intrinsics[0], (color_size, depth_size))
    pose = _poses(container, times[paired], per_second)

    def view(number: int, per_meter: float) -> DepthPicture:
        depth = container.meters(pairs[number][1], depth_size, per_meter)
        return DepthPicture(depth, cameras.scale_intrinsics(intrinsics[number], color_size, depth_size))

    per_meter, scale_remarks = _units_per_meter(container, pose, times[paired], view)
    return Recording(
        where=container.where,
        kind="TUM RGB-D",
        index=np.arange(len(pairs)),
        timestamp_s=times[paired] - times[paired[0]],
        intrinsics=intrinsics,
        pose=pose,
        color_size=color_size,
        depth_size=depth_size,
        read_color=lambda i: container.read(pairs[i][0]),
        read_depth=lambda i: container.meters(pairs[i][1], depth_size, per_meter),
        depth_camera=camera,
        remarks=remarks + unit_remarks + scale_remarks + camera_remarks,
        listed=len(present),
    )


def partners(
    times: Float[np.ndarray, "frame"], others: Float[np.ndarray, "other"]
) -> Int[np.ndarray, "frame"]:
    """Return the index of the nearest of `others` (increasing) to each time, -1 beyond `NEAREST_S`."""
    best = subsampling.nearest(others, times)
    return np.where(np.abs(others[best] - times) <= NEAREST_S, best, -1)


def _listed(container: FolderContainer, name: str) -> list[tuple[float, str]]:
    """Return (time, file) of every line, in time order."""
    found = []
    for line in text_files.lines(container, name):
        cells = line.replace("\\", "/").replace(",", " ").split()
        try:
            time_s = float(cells[0])
            if not np.isfinite(time_s):
                raise ValueError(time_s)
            found.append((time_s, cells[1].removeprefix("./")))
        except (ValueError, IndexError) as error:
            why = f"{line[:QUOTED]!r} is no time and file name"
            raise errors.broken_metadata(container.place(name), why) from error
    return sorted(dict(found).items())


def _poses(
    container: FolderContainer, times: Float[np.ndarray, "frame"], per_second: float
) -> Float[np.ndarray, "frame 7"] | None:
    """Return the pose nearest in time to each frame, NaN if there is none within 20 ms."""
    if "groundtruth.txt" not in container.names:
        return None
    table = text_files.table(container, "groundtruth.txt", 8)
    table = table[np.isfinite(table[:, 0])]
    if len(table) == 0:
        return None
    table = table[np.argsort(table[:, 0], kind="stable")]
    partner = partners(times, table[:, 0] / per_second)
    pose = table[partner][:, [4, 5, 6, 7, 1, 2, 3]]
    pose[partner < 0] = np.nan
    return pose


def _units_per_meter(
    container: FolderContainer,
    pose: Float[np.ndarray, "frame 7"] | None,
    timestamp_s: Float[np.ndarray, "frame"],
    view: Callable[[int, float], DepthPicture],
) -> tuple[float, tuple[str, ...]]:
    """Return the units of `depth_scale.txt`, else millimeters if the poses fit them, else the data set's."""
    name = "depth_scale.txt"
    if name in container.names:
        per_meter = float(text_files.table(container, name, 1, rows=1)[0, 0])
        if not 0 < per_meter < np.inf:
            raise errors.broken_metadata(container.place(name), "the units per meter must be positive")
        return per_meter, ()
    assumed = PER_METER, (f"no {name}: {PER_METER:g} units per meter are assumed",)
    known = np.arange(0) if pose is None else np.flatnonzero(np.isfinite(pose).all(1))
    if pose is None or not len(known):
        return assumed
    tracked = pose[known], timestamp_s[known]

    def residual(per_meter: float) -> float:
        check = check_poses(*tracked, lambda i: view(known[i], per_meter), documented=OPENCV, among=(OPENCV,))
        return check.residual_m / check.tolerance_m

    best = min(OTHERS, key=residual)
    if residual(best) < min(1.0, MAX_RESIDUAL_RATIO * residual(PER_METER)):
        fit = f"{best:g} units per meter fit the poses, the set's {PER_METER:g} do not"
        return best, (f"no {name}: {fit}",)
    return assumed
