"""Drift of device poses: depth compared between frames that revisit a place."""

from collections.abc import Sequence

import numpy as np

from pipeline.recordings.conventions import DepthPicture, compare
from stages.check_captures.sampling import SampledFrame

LATER_S = 5.0
MIN_OVERLAP = 0.3
MAX_PAIRS = 60
SAME_DIRECTION, NEAR_M = 0.8, 1.5
"""Minimum cosine between optical axes, and maximum distance, of cameras with overlapping views."""


def drift_m(shots: Sequence[SampledFrame]) -> float:
    """Return the median disagreement of depth between frames at least 5 s apart, meters; NaN without any."""
    if len(shots) < 2 or shots[0].odometry_from_camera is None:
        return np.nan
    pairs = [
        (first, second)
        for i, first in enumerate(shots)
        for second in shots[i + 1 :]
        if second.timestamp_s - first.timestamp_s >= LATER_S and _similar_views(first, second)
    ]
    found = []
    for first, second in pairs[:: max(1, len(pairs) // MAX_PAIRS)]:
        views = [DepthPicture(shot.depth, shot.depth_intrinsics) for shot in (first, second)]
        second_from_first = second.camera_from_odometry @ first.odometry_from_camera
        residual_m, overlap, _ = compare(*views, second_from_first=second_from_first)
        if overlap > MIN_OVERLAP:
            found.append(residual_m)
    return float(np.median(found)) if found else np.nan


def _similar_views(first: SampledFrame, second: SampledFrame) -> bool:
    """Return whether two cameras have similar poses."""
    relative = first.camera_from_odometry @ second.odometry_from_camera
    return relative[2, 2] > SAME_DIRECTION and float(np.linalg.norm(relative[:3, 3])) < NEAR_M
