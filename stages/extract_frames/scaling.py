"""Metres for a map without them: recordings with depth that show the same room tell how long its unit is.

Points that look alike in a frame of the map and in a frame with measured depth are fitted by a similarity; the median of
its scale over the pairs that agree is taken, and only when enough of them do.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import pycolmap

from pipeline.recordings import extraction
from pipeline.recordings.recording import Recording
from pipeline.space import sift_points
from pipeline.space.sift_points import SiftPoints


@dataclass(frozen=True)
class ScalingOptions:
    """When recordings with depth are believed to tell the map's scale."""

    frames: int = 24
    """Frames looked at per recording with depth."""
    points: int = 800
    """SIFT points per frame."""
    within_m: float = 0.08
    """Matched points this close after the fit agree, metres."""
    least_points: int = 15
    """Points that must agree for a pair of frames to count."""
    least_pairs: int = 4
    """Pairs that must agree for the scale to be believed."""
    agree_share: float = 0.1
    """Relative difference of scale within which pairs agree."""


def meters_per_unit(mapped: Sequence[SiftPoints], measured: Recording, options: ScalingOptions, seed: int) -> float | None:
    """Return how many metres a unit of the map is by one recording with depth; None where it does not tell."""
    scales = []
    for frame in _described(measured, options):
        found = [scale for known in mapped if (scale := _scale(known, frame, options, seed)) is not None]
        scales += found
    if not scales:
        return None
    centre = float(np.median(scales))
    agreeing = np.abs(np.array(scales) / centre - 1) < options.agree_share
    if agreeing.sum() < max(options.least_pairs, 0.5 * len(scales)):
        return None
    return float(np.median(np.array(scales)[agreeing]))


def _described(recording: Recording, options: ScalingOptions) -> Iterator[SiftPoints]:
    plan = extraction.understand(recording, rate_hz=10.0, max_depth_m=5.0, pairs=6, max_side_px=640)
    rows = np.unique(np.linspace(0, len(plan.chosen) - 1, options.frames).round().astype(int))
    sample = replace(plan, chosen=plan.chosen[rows])
    for row, frame in zip(rows, extraction.frames(recording, sample, max_depth_m=5.0, jpeg_quality=50), strict=True):
        if frame is not None:
            gray = cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY)
            yield sift_points.sift_points(gray, plan.intrinsics[row], frame.depth, plan.depth_intrinsics[row], options.points)


def _scale(known: SiftPoints, frame: SiftPoints, options: ScalingOptions, seed: int) -> float | None:
    """Return metres per unit by one pair of frames, None where too few points agree."""
    mine, theirs = sift_points.matches(frame, known).T
    if len(mine) < options.least_points:
        return None
    source, target = known.points_camera[theirs], frame.points_camera[mine]
    ransac = pycolmap.RANSACOptions(max_error=options.within_m, random_seed=seed, max_num_trials=2000)
    fitted = pycolmap.estimate_sim3d_robust(source, target, ransac)
    if fitted is None:
        return None
    close = target[np.asarray(fitted["inlier_mask"], bool)]
    if len(close) < options.least_points or np.ptp(close, axis=0).max() < 5 * options.within_m:
        return None
    return float(fitted["tgt_from_src"].scale)
