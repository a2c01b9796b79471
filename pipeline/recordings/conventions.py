"""Verify a recording's device poses and their convention against its depth.

The depth of a few frames is warped by the poses into other frames and compared with the depth there. The
documented convention is kept unless it is clearly refuted and another one clearly fits.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from pipeline.geometry import cameras, rigid
from pipeline.geometry.subsampling import evenly

TOLERANCE_M = 0.015
TOLERANCE_SHARE = 0.01
UNUSABLE_FACTOR = 4.0
"""residual, in tolerances, beyond which poses are wrong and not merely drifting"""
UNIT_FACTORS = (0.1, 0.2, 0.5, 2.0, 5.0, 10.0)
"""ratios of units of depth in use: 0.1, 0.2, 1 and 10 mm"""
MAX_COST_SHARE = 0.5
"""another convention or unit is preferred if its cost is below this share of the stored one's"""
MIN_OVERLAP = 0.25
MIN_TURN_RAD = np.radians(3.0)
MIN_SHIFT_M = 0.05
POSE_PAIRS = 6
"""pairs of frames on which device poses are checked against depth"""
GAP_S = (0.33, 1.5)
GAP_FRAMES = 2.5
"""maximum gap of a pair at low frame rates, in frames"""
NEAREST_M = 0.05
"""points nearer to the second camera are not compared"""
MIN_COMPARED = 50
"""minimum number of common points of a pair"""
UNIT_TOLERANCE = 0.05
"""tolerance of a quaternion's norm, for values rounded to a few digits"""
STRIDE_PX, POINTS_A_SIDE = 3, 80
"""points are sampled every third pixel of the first picture, at most 80 along its longer side"""


@dataclass(frozen=True)
class Convention:
    """How seven stored numbers become the pose of a camera with OpenCV axes."""

    direction: Literal["camera_to_world", "world_to_camera"] = "camera_to_world"
    axes: Literal["opengl", "opencv"] = "opengl"
    quarter_turns: int = 0
    """clockwise turns from the stored picture to the camera of the poses"""
    quaternion: Literal["xyzw", "wxyz"] = "xyzw"


OPENGL = Convention()
"""Record3D, Polycam, NeRFCapture"""
OPENCV = Convention(axes="opencv")
"""Stray Scanner, TUM, 7-Scenes"""
CONVENTIONS = tuple(
    Convention(*choice)
    for choice in product(
        ("camera_to_world", "world_to_camera"), ("opengl", "opencv"), range(4), ("xyzw", "wxyz")
    )
)


@dataclass(frozen=True)
class DepthPicture:
    """One frame's depth (meters, 0 = unknown) and its intrinsics."""

    depth: Float[np.ndarray, "height width"]
    intrinsics: Float[np.ndarray, "3 3"]


Verdict = Literal["documented", "other", "untested", "unusable"]


@dataclass(frozen=True)
class PoseCheck:
    """Result of comparing device poses with the depth."""

    verdict: Verdict
    convention: Convention
    reason: str
    residual_m: float = np.nan
    """median over pairs of the median depth difference; NaN when nothing could be compared"""
    tolerance_m: float = TOLERANCE_M
    """allowed residual, which grows with depth"""
    depth_factor: float = 1.0
    """factor on the stored depth with which it would agree with poses or the walk-through"""


def odometry_from_pose(
    pose: Float[np.ndarray, "frame 7"], convention: Convention
) -> Float[np.ndarray, "frame 4 4"]:
    """Turn stored poses into ``odometry_from_camera`` with OpenCV axes of the stored picture."""
    quaternion = np.roll(pose[:, :4], 1, axis=1) if convention.quaternion == "xyzw" else pose[:, :4]
    odometry_from_camera = rigid.make(rigid.rotation_from_quaternion(quaternion), pose[:, 4:])
    if convention.direction == "world_to_camera":
        odometry_from_camera = rigid.inverse(odometry_from_camera)
    if convention.axes == "opengl":
        odometry_from_camera = cameras.opencv_from_opengl(odometry_from_camera)
    return cameras.turn_camera(odometry_from_camera, -convention.quarter_turns)


def check_poses(
    pose: Float[np.ndarray, "frame 7"] | None,
    timestamp_s: Float[np.ndarray, "frame"],
    depth_view: Callable[[int], DepthPicture],
    documented: Convention = OPENGL,
    among: Sequence[Convention] = CONVENTIONS,
) -> PoseCheck:
    """Find the convention, ``among`` the given ones, that poses follow; ``depth_view`` reads a depth map."""
    broken = "the recording has no device poses" if pose is None else _invalid_reason(pose)
    if pose is None or broken:
        return PoseCheck("unusable", documented, broken)
    chosen = moving_pairs(odometry_from_pose(pose, documented), timestamp_s, POSE_PAIRS)
    if len(chosen) == 0:
        return PoseCheck("untested", documented, "the phone moved too little to test its poses")
    frames, position = np.unique(chosen, return_inverse=True)
    pairs_of_views, views = position.reshape(chosen.shape), [depth_view(frame) for frame in frames.tolist()]
    scores = {
        convention: _score(odometry_from_pose(pose[frames], convention), pairs_of_views, views)
        for convention in among
    }
    check, odometry = _judge(scores, documented), odometry_from_pose(pose[frames], documented)
    if check.verdict == "other":
        return check
    factor = _depth_factor(odometry, pairs_of_views, views, scores[documented])
    if factor == 1:
        return check
    reason = f"poses contradict the depth; depth times {factor:g} would agree with them: check its unit"
    return replace(check, verdict="unusable", reason=reason, depth_factor=factor)


def _depth_factor(
    odometry_from_camera: np.ndarray, pairs: np.ndarray, views: Sequence[DepthPicture], stored: "_Score"
) -> float:
    """Return the factor of another unit in which the depth clearly agrees better with the poses, or 1.

    The cost must fall both in meters (errors of poses do not) and relative to the depth (its noise does not).
    """
    best, found = UNUSABLE_FACTOR, 1.0
    for factor in UNIT_FACTORS:
        scaled = [replace(view, depth=view.depth * np.float32(factor)) for view in views]
        score = _score(odometry_from_camera, pairs, scaled)
        clearly = score.cost < MAX_COST_SHARE * min(1.0, factor) * stored.cost
        if clearly and score.residual_m < min(best * score.tolerance_m, factor * stored.tolerance_m):
            best, found = score.residual_m / score.tolerance_m, factor
    return found


@dataclass(frozen=True)
class _Score:
    residual_m: float
    overlap: float
    tolerance_m: float
    accepted: bool

    @property
    def cost(self) -> float:
        return self.residual_m / max(self.overlap, 1e-3)


def _invalid_reason(pose: Float[np.ndarray, "frame 7"]) -> str:
    """Return why poses are invalid regardless of depth; empty if they may be valid."""
    if not np.isfinite(pose).all():
        return "device poses are not finite"
    if np.any(np.abs(np.linalg.norm(pose[:, :4], axis=1) - 1) > UNIT_TOLERANCE):
        return "device poses hold quaternions that are not of unit length"
    if len(pose) > 1 and np.ptp(pose, axis=0).max() < 1e-6:
        return "all device poses are the same"
    return ""


def moving_pairs(
    odometry_from_camera: Float[np.ndarray, "frame 4 4"],
    timestamp_s: Float[np.ndarray, "frame"],
    pairs: int,
    gap_s: float = GAP_S[0],
) -> Int[np.ndarray, "pair 2"]:
    """Pick up to ``pairs`` frame pairs with time and motion between them, spread over the recording."""
    second = np.searchsorted(timestamp_s, timestamp_s + gap_s)
    first = np.flatnonzero(second < len(timestamp_s))
    if len(first) == 0:
        return np.zeros((0, 2), int)
    second = second[first]
    relative = rigid.inverse(odometry_from_camera[first]) @ odometry_from_camera[second]
    moved = rigid.rotation_angle(np.eye(3), relative[:, :3, :3]) > MIN_TURN_RAD
    moved |= np.linalg.norm(relative[:, :3, 3], axis=1) > MIN_SHIFT_M
    longest_s = max(gap_s - GAP_S[0] + GAP_S[1], GAP_FRAMES * float(np.median(np.diff(timestamp_s))))
    close = timestamp_s[second] - timestamp_s[first] <= longest_s
    usable = np.stack([first, second], axis=1)[moved & close]
    return usable[evenly(len(usable), pairs, rounded=True)]


def _score(
    odometry_from_camera: Float[np.ndarray, "frame 4 4"], pairs: np.ndarray, views: Sequence[DepthPicture]
) -> _Score:
    """Compare depth over all pairs under one convention."""
    rows = []
    for first, second in pairs:
        second_from_first = rigid.inverse(odometry_from_camera[second]) @ odometry_from_camera[first]
        rows.append(compare(views[first], views[second], second_from_first))
    residual_m, overlap, tolerance_m = np.array(rows).T
    accepted = (residual_m < tolerance_m) & (overlap > MIN_OVERLAP)
    return _Score(*np.median(rows, axis=0).tolist(), accepted=bool(accepted.mean() >= 0.5))


def compare(
    first: DepthPicture, second: DepthPicture, second_from_first: Float[np.ndarray, "4 4"]
) -> tuple[float, float, float]:
    """Return (median depth difference in meters, share of compared points, tolerance in meters)."""
    stride = max(STRIDE_PX, max(first.depth.shape) // POINTS_A_SIDE)
    every = np.s_[stride // 2 :: stride, stride // 2 :: stride]
    points_first = cameras.back_project(first.depth, first.intrinsics)[every][first.depth[every] > 0]
    points_second = rigid.apply(second_from_first, points_first)
    measured = cameras.lookup_depth(second.depth, second.intrinsics, points_second, NEAREST_M)
    difference = np.abs(points_second[:, 2] - measured)[measured > 0]
    if len(difference) < MIN_COMPARED:
        return np.inf, 0.0, TOLERANCE_M
    tolerance_m = max(TOLERANCE_M, TOLERANCE_SHARE * float(np.median(measured[measured > 0])))
    return float(np.median(difference)), len(difference) / len(points_first), tolerance_m


def _judge(scores: dict[Convention, _Score], documented: Convention) -> PoseCheck:
    """Keep the documented convention unless it is refuted and another one clearly fits."""
    score, best = scores[documented], min(scores, key=lambda convention: scores[convention].cost)
    verdict: Verdict = "documented"
    if score.accepted:
        reason = "the documented convention explains the depth"
    elif scores[best].accepted and scores[best].cost < MAX_COST_SHARE * score.cost:
        verdict, documented, score = "other", best, scores[best]
        reason = f"the documented convention is refuted by the depth; {best} explains it"
    elif score.residual_m < UNUSABLE_FACTOR * score.tolerance_m and score.overlap > MIN_OVERLAP:
        reason = "device poses explain the depth only roughly: they drift"
    else:
        verdict, reason = "unusable", "device poses do not explain the depth under any convention"
    return PoseCheck(verdict, documented, reason, score.residual_m, score.tolerance_m)
