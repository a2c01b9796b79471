"""TUM RGB-D folders: `rgb.txt`, `depth.txt` and, where there is one, `groundtruth.txt`, associated by time.

Depth is registered to the colour picture, 5000 units per metre. Intrinsics from `intrinsics.txt` or the set's default.
"""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from pipeline.files import images
from pipeline.recordings import text_files
from pipeline.recordings.containers import FolderContainer
from pipeline.recordings.conventions import OPENCV
from pipeline.recordings.recording import (
    MAX_PICTURE_BYTES,
    MAX_TEXT_BYTES,
    Recording,
    broken_metadata,
    intrinsics_from_coefficients,
    meters_from_png,
    no_depth,
    no_frames,
)  # fmt: skip

PER_METER = 5000.0
NEAREST_S = 0.02
"""largest difference in time between a colour picture, its depth and its pose, seconds"""
DEFAULT = (525.0, 525.0, 319.5, 239.5)
"""fx, fy, cx, cy that the set recommends for 640 x 480, pixels"""


def open_recording(path: Path) -> Recording:
    """Open a TUM folder. Raises InputError CAP-003..011."""
    container = FolderContainer(path)
    color, depth = (_listed(container, name) for name in ("rgb.txt", "depth.txt"))
    if not depth:
        raise no_depth(container.where, "depth.txt lists nothing")
    if not color:
        raise no_frames(container.where, "rgb.txt lists nothing")
    times = np.array([time for time, _ in color])
    partner = nearest(times, np.array([time for time, _ in depth]), NEAREST_S)
    kept = np.flatnonzero(partner >= 0)
    pairs = [(color[i][1], depth[partner[i]][1]) for i in kept]
    present = np.array([set(pair) <= container.names for pair in pairs], bool)
    kept, pairs = kept[present], [pair for pair, there in zip(pairs, present, strict=True) if there]
    if not pairs:
        raise no_frames(container.where, "no colour picture has depth within 20 ms")
    color_size = images.decode_color(container.read(pairs[0][0], MAX_PICTURE_BYTES), container.where).shape[:2]
    depth_size = meters_from_png(container.read(pairs[0][1], MAX_PICTURE_BYTES), None, container.where).shape
    coefficients, remarks = text_files.coefficients(container, default=DEFAULT if color_size == (480, 640) else None)
    return Recording(
        where=container.where,
        kind="TUM RGB-D",
        index=np.arange(len(pairs)),
        timestamp_s=times[kept] - times[kept[0]],
        intrinsics=intrinsics_from_coefficients(np.tile(coefficients, (len(pairs), 1)), container.where),
        pose=_poses(container, times[kept]),
        color_size=color_size,
        depth_size=depth_size,
        read_color=lambda i: container.read(pairs[i][0], MAX_PICTURE_BYTES),
        read_depth=lambda i: meters_from_png(
            container.read(pairs[i][1], MAX_PICTURE_BYTES), depth_size, f"{container.where}/{pairs[i][1]}", PER_METER
        ),
        convention=OPENCV,
        remarks=remarks,
    )


def nearest(times: Float[np.ndarray, "frame"], others: Float[np.ndarray, "other"], within_s: float) -> np.ndarray:
    """Return for each time the index of the nearest of `others` (increasing), -1 where none is near enough."""
    right = np.clip(np.searchsorted(others, times), 1, max(len(others) - 1, 1))
    left = np.clip(right - 1, 0, len(others) - 1)
    right = np.clip(right, 0, len(others) - 1)
    best = np.where(np.abs(others[left] - times) <= np.abs(others[right] - times), left, right)
    return np.where(np.abs(others[best] - times) <= within_s, best, -1)


def _listed(container: FolderContainer, name: str) -> list[tuple[float, str]]:
    """Return (time, file) of every line, in time order."""
    found = []
    for line in text_files.lines(container, name):
        cells = line.split()
        try:
            found.append((float(cells[0]), cells[1]))
        except (ValueError, IndexError) as error:
            raise broken_metadata(f"{container.where}/{name}", f"{line[:40]!r} is no time and file name") from error
    return sorted(dict(found).items())


def _poses(container: FolderContainer, times: Float[np.ndarray, "frame"]) -> Float[np.ndarray, "frame 7"] | None:
    """Return the pose nearest in time to each frame, NaN where there is none within 20 ms; None without the file."""
    if "groundtruth.txt" not in container.names:
        return None
    table = text_files.table(
        container.read("groundtruth.txt", MAX_TEXT_BYTES).decode(errors="replace"), 8, f"{container.where}/groundtruth.txt"
    )
    if len(table) == 0:
        return None
    table = table[np.argsort(table[:, 0], kind="stable")]
    partner = nearest(times, table[:, 0], NEAREST_S)
    pose = table[partner][:, [4, 5, 6, 7, 1, 2, 3]]
    pose[partner < 0] = np.nan
    return pose
