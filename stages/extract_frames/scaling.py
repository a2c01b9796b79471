"""Metric scale of a map without depth, from recordings of the same room with depth.

Points that look alike in a frame of the map and in a frame with measured depth are fitted by a
similarity; the median of its scale over the pairs that agree is taken, and only when enough of them do.
"""

from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, cast

import cv2
import numpy as np
import pycolmap

from pipeline.calibration import recordings as calibration
from pipeline.calibration.given import GivenCalibration
from pipeline.geometry.subsampling import evenly
from pipeline.mapping import sift
from pipeline.mapping.sift import SiftPoints
from pipeline.recordings import extraction
from pipeline.recordings.recording import Recording

FRAMES = 24
"""frames used per recording with depth"""
POINTS = 800
"""SIFT points per frame"""
WITHIN_M = 0.08
"""inlier threshold of the fit, meters: the noise of phone depth at a few meters"""
MIN_EXTENT_M = 5 * WITHIN_M
"""minimum extent of the inliers along some axis for a reliable scale"""
MIN_POINTS = 15
"""minimum number of inliers of a pair of frames"""
MIN_PAIRS = 4
"""minimum number of pairs with consistent scale"""
AGREE_SHARE = 0.1
"""relative difference of scale within which pairs are consistent"""
RANSAC_TRIALS = 2000
RATE_HZ, MAX_DEPTH_M, MAX_SIDE_PX = 10.0, 5.0, 640
"""extraction settings for recordings with depth"""


MeasuredRecording = tuple[Recording, GivenCalibration]
"""a recording with depth, and what its user says about that"""


def meters_per_unit(mapped: Sequence[SiftPoints], measured: MeasuredRecording, seed: int) -> float | None:
    """Return meters per unit of the map by one recording with depth, None if too few pairs agree."""
    scales = []
    for frame in _described(*measured):
        scales += [scale for known in mapped if (scale := _scale(known, frame, seed)) is not None]
    if not scales:
        return None
    center = float(np.median(scales))
    agreeing = np.abs(np.array(scales) / center - 1) < AGREE_SHARE
    if agreeing.sum() < max(MIN_PAIRS, 0.5 * len(scales)):
        return None
    return float(np.median(np.array(scales)[agreeing]))


def _described(recording: Recording, given: GivenCalibration) -> Iterator[SiftPoints]:
    options = {"rate_hz": RATE_HZ, "max_side_px": MAX_SIDE_PX, "max_depth_m": MAX_DEPTH_M}
    found, plan = calibration.understand(recording, given, **options)
    rows = evenly(len(plan.chosen), FRAMES, rounded=True)
    sample = replace(plan, chosen=plan.chosen[rows])
    frames = extraction.frames(found.recording, sample, max_depth_m=MAX_DEPTH_M)
    for row, frame in zip(rows, frames, strict=True):
        if frame is not None:
            gray, lens = cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY), plan.depth_intrinsics[row]
            yield sift.lift(sift.describe(gray, POINTS), plan.intrinsics[row], frame.depth, lens)


def _scale(known: SiftPoints, frame: SiftPoints, seed: int) -> float | None:
    """Return meters per unit by one pair of frames, None with too few inliers."""
    mine, theirs = sift.matches(frame.descriptors, known.descriptors).T
    if len(mine) < MIN_POINTS:
        return None
    source, target = known.points_camera[theirs], frame.points_camera[mine]
    ransac = pycolmap.RANSACOptions(max_error=WITHIN_M, random_seed=seed, max_num_trials=RANSAC_TRIALS)
    # The stub names the transform alone; the function returns it with the inliers.
    fitted = cast("dict[str, Any] | None", pycolmap.estimate_sim3d_robust(source, target, ransac))
    if fitted is None:
        return None
    close = target[np.asarray(fitted["inlier_mask"], bool)]
    if len(close) < MIN_POINTS or np.ptp(close, axis=0).max() < MIN_EXTENT_M:
        return None
    return float(fitted["tgt_from_src"].scale)
