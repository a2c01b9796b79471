"""Check that a recording shows the walk-through's room: SIFT with depth, rigid fits, temporal consistency.

Also the drift of device poses: depth compared between frames that revisit a place.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from pipeline.geometry import align, rigid
from pipeline.mapping import sift
from pipeline.mapping.picture_agreement import beats
from pipeline.mapping.sift import SiftPoints
from pipeline.recordings.conventions import UNIT_FACTORS, DepthPicture, compare
from stages.check_captures.sampling import SampledFrame

POINTS = 600
WITHIN_M = 0.06
MIN_INLIERS = 10
"""minimum inliers to localize a frame"""
AGREE = (15.0, 0.6)
"""tolerances for consistent poses, degrees and meters"""
TRIALS = 300
LATER_S = 5.0
MIN_OVERLAP = 0.3
MAX_PAIRS = 60
SAME_DIRECTION, NEAR_M = 0.8, 1.5
"""minimum cosine between optical axes, and maximum distance, of cameras with overlapping views"""


@dataclass(frozen=True)
class DescribedFrame:
    """One frame and its keypoints with depth."""

    shot: SampledFrame
    points: SiftPoints


def describe(shots: Sequence[SampledFrame]) -> list[DescribedFrame]:
    """Extract keypoints of frames; those with too few are omitted."""
    found = []
    for shot in shots:
        keypoints = sift.describe(shot.gray, POINTS)
        points = sift.lift(keypoints, shot.intrinsics, shot.depth, shot.depth_intrinsics)
        if len(points.points_camera) >= MIN_INLIERS:
            found.append(DescribedFrame(shot, points))
    return found


def placed_share(
    walkthrough: Sequence[DescribedFrame], session: Sequence[DescribedFrame], rng: np.random.Generator
) -> float:
    """Return the share (0..1) of session frames localized in the walk-through with consistent poses."""
    if not session or not walkthrough:
        return 0.0
    votes = [_best_place(walkthrough, frame, rng) for frame in session]
    placed = [vote for vote in votes if vote is not None]
    with_odometry = all(shown[0].shot.odometry_from_camera is not None for shown in (walkthrough, session))
    if not placed or not with_odometry:
        return len(placed) / len(session)
    places = np.stack(placed)
    degrees = np.degrees(rigid.rotation_angle(places[:, None, :3, :3], places[None, :, :3, :3]))
    meters = np.linalg.norm(places[:, None, :3, 3] - places[None, :, :3, 3], axis=-1)
    agreeing = int(((degrees < AGREE[0]) & (meters < AGREE[1])).sum(1).max())
    return agreeing / len(session) if agreeing >= 2 else 0.0


def depth_factor(
    walkthrough: Sequence[DescribedFrame], session: Sequence[DescribedFrame], rng: np.random.Generator
) -> float:
    """Return the unit's factor with which frames clearly fit their most similar ones of the room, or 1."""
    inliers = np.zeros((len(session), 1 + len(UNIT_FACTORS)))
    room = [each.points for each in walkthrough]
    for row, points in enumerate(each.points for each in session):
        found = [(each, sift.matches(points.descriptors, each.descriptors)) for each in room]
        known, pairs = max(found, key=lambda each: len(each[1]))
        mine, theirs = points.points_camera[pairs[:, 0]], known.points_camera[pairs[:, 1]]
        for column, factor in enumerate((1.0, *UNIT_FACTORS)):
            trial = {"threshold_m": WITHIN_M, "iterations": TRIALS, "rng": rng}
            inliers[row, column] = align.ransac_rigid(factor * mine, theirs, **trial)[1].sum()
    better = [beats(each, inliers[:, 0], len(UNIT_FACTORS)) for each in inliers.T[1:]]
    return (1.0, *UNIT_FACTORS)[int(np.argmax(inliers.sum(0) * [True, *better]))]


def _best_place(
    walkthrough: Sequence[DescribedFrame], frame: DescribedFrame, rng: np.random.Generator
) -> Float[np.ndarray, "4 4"] | None:
    """Return the pose of the session's odometry in the walk-through's by one frame, None without a fit."""
    best, place = MIN_INLIERS - 1, None
    for known in walkthrough:
        mine, theirs = sift.matches(frame.points.descriptors, known.points.descriptors).T
        if len(mine) <= best:
            continue
        matched = (frame.points.points_camera[mine], known.points.points_camera[theirs])
        fitted, agree = align.ransac_rigid(*matched, threshold_m=WITHIN_M, iterations=TRIALS, rng=rng)
        if agree.sum() > best:
            best, place = int(agree.sum()), fitted
            if known.shot.odometry_from_camera is not None and frame.shot.odometry_from_camera is not None:
                place = known.shot.odometry_from_camera @ fitted @ frame.shot.camera_from_odometry
    return place


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
