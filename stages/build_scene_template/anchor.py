"""Anchor the walk-through in the world: metric scale from depth, propagation by odometry, gravity.

If depth contradicts the sparse model, odometry is the initial trajectory.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float, Int
from scipy.spatial.distance import pdist

from pipeline.data.clips import Clip
from pipeline.geometry import align, cameras, ground, rigid
from pipeline.mapping.bundle_adjustment import MAD_TO_SIGMA
from pipeline.mapping.colmap import SparseModel
from stages.build_scene_template.refine import Keyframe
from stages.build_scene_template.sfm import back_project

MIN_REGISTERED = 0.6
"""Least share of the keyframes in the largest model; with less, odometry is more complete."""
MAX_SCALE_DEVIATION = 0.06
"""Largest robust relative deviation of the ratio of depth to SfM depth; good models have 1-3 %."""
MAX_GAP_M, MAX_GAP_RATIO = 0.06, 1.5
"""The model is rejected if its depth gap (meters) exceeds the first, and the second times odometry's gap."""
MIN_RATIOS = 20
"""Least number of observations with depth for the scale."""
HOPS = (1, 3, 8)
"""Index distances of keyframes whose depth images are compared."""
GAP_QUANTILE, MIN_OVERLAP = 0.75, 50
"""Quantile of a pair's depth differences, and least number of overlapping points of a pair."""
MIN_DEPTH_M = 0.1
"""Smaller depth counts as missing, meters."""


@dataclass(frozen=True)
class InitialTrajectory:
    """Initial poses of every frame, their source, and the diagnostics of SfM."""

    world_from_camera: Float[np.ndarray, "frame 4 4"]
    source: Literal["colmap", "odometry"]
    reason: str
    """Why SfM was rejected; empty if it was accepted."""
    registered: Int[np.ndarray, "key"]
    scale_deviation: float | None
    """Robust relative standard deviation of depth over SfM depth."""
    gap_m: dict[str, float]
    """`depth_gap` of each candidate trajectory."""


def metric_scale(sparse: SparseModel, clip: Clip) -> tuple[float, float] | None:
    """Return meters per model unit and its robust relative deviation, from depth; None if too few."""
    ratios = []
    for view, frame in enumerate(sparse.frame):
        row = np.flatnonzero(sparse.observed_key == view)
        measured = back_project(clip, int(frame), sparse.observed_pixel[row])[:, 2]
        camera_from_model = rigid.inverse(sparse.model_from_camera[view])
        model = rigid.apply(camera_from_model, sparse.points_model[sparse.observed_point[row]])[:, 2]
        ratios.append((measured / model)[np.isfinite(measured) & (model > 0)])
    ratio = np.concatenate(ratios)
    if len(ratio) < MIN_RATIOS:
        return None
    scale = float(np.median(ratio))
    return scale, float(MAD_TO_SIGMA * np.median(np.abs(ratio - scale)) / scale)


def depth_gap(keyframes: list[Keyframe], world_from_camera: Float[np.ndarray, "key 4 4"]) -> float:
    """Return the mean over keyframe pairs `HOPS` apart of a quantile of their depth differences, meters."""
    gaps = []
    for hop in HOPS:
        for first in range(len(keyframes) - hop):
            target = keyframes[first + hop]
            target_from_first = rigid.inverse(world_from_camera[first + hop]) @ world_from_camera[first]
            moved = rigid.apply(target_from_first, keyframes[first].scan.points_camera)
            measured = cameras.lookup_depth(target.depth, target.intrinsics, moved, MIN_DEPTH_M)
            gap = np.abs(measured - moved[:, 2])[measured > 0]
            gaps.append(np.quantile(gap, GAP_QUANTILE) if len(gap) > MIN_OVERLAP else np.nan)
    return float(np.nanmean(gaps)) if np.isfinite(gaps).any() else np.inf


def propagate(
    clip: Clip, frames: Int[np.ndarray, "key"], world_from_camera: Float[np.ndarray, "key 4 4"]
) -> Float[np.ndarray, "frame 4 4"]:
    """Propagate keyframe poses to all frames along odometry, blended from both sides; else interpolate."""
    time = clip.timestamp_s
    if clip.odometry_from_camera is None:
        return rigid.interpolate(time[frames], world_from_camera, time)
    odometry = clip.odometry_from_camera
    world_from_odometry = world_from_camera @ rigid.inverse(odometry[frames])
    after = np.searchsorted(frames, np.arange(len(time)), side="right").clip(1).clip(max=len(frames) - 1)
    before = np.maximum(after - 1, 0)
    gap_s = time[frames[after]] - time[frames[before]]
    blend = np.clip((time - time[frames[before]]) / np.maximum(gap_s, 1e-9), 0, 1)
    ends = [world_from_odometry[index] @ odometry for index in (before, after)]
    step = rigid.log(rigid.inverse(ends[0]) @ ends[1])
    return ends[0] @ rigid.exp(step * blend[:, None])


def choose_trajectory(
    clip: Clip, frames: Int[np.ndarray, "key"], keyframes: list[Keyframe], sparse: SparseModel | None
) -> InitialTrajectory | None:
    """Return SfM poses if enough keyframes are registered, scale and depth are consistent; else odometry.

    None where neither is available.
    """
    odometry = clip.odometry_from_camera
    gap = {} if odometry is None else {"odometry": depth_gap(keyframes, odometry[frames])}
    deviation = poses = None
    if sparse is None:
        reason, registered = "COLMAP found no model", np.zeros(0, int)
    elif (measured := metric_scale(sparse, clip)) is None:
        reason, registered = "too few of its points have depth", sparse.frame
    else:
        registered, (scale, deviation) = sparse.frame, measured
        poses = sparse.model_from_camera.copy()
        poses[:, :3, 3] *= scale
        poses = propagate(clip, registered, poses)
        gap["colmap"] = depth_gap(keyframes, poses[frames])
        reason = _rejection_reason(len(registered) / len(frames), deviation, gap)
    if odometry is not None and (poses is None or reason):
        return InitialTrajectory(odometry, "odometry", reason, registered, deviation, gap)
    if poses is None:
        return None
    return InitialTrajectory(poses, "colmap", reason, registered, deviation, gap)


def odometry_scale(clip: Clip, world_from_camera: Float[np.ndarray, "frame 4 4"]) -> float | None:
    """Return the median ratio of odometry's distances between distant cameras to the world's, ideally 1.

    Noise hardly changes them, unlike lengths of paths. Unknown (NaN) cameras are left out.
    """
    odometry, known = clip.odometry_from_camera, np.isfinite(world_from_camera).all((1, 2))
    if odometry is None or known.sum() < 2:
        return None
    odometry_m, world_m = (pdist(each[known, :3, 3]) for each in (odometry, world_from_camera))
    far = world_m >= np.median(world_m)
    return float(np.median(odometry_m[far] / np.maximum(world_m[far], 1e-9)))


def _rejection_reason(registered, deviation, gap):
    """Return why the sparse model is rejected; empty if it is not."""
    if registered < MIN_REGISTERED:
        return f"only {registered:.0%} of the keyframes were registered"
    if deviation > MAX_SCALE_DEVIATION:
        return f"its scale varies by {deviation:.1%} against depth"
    if gap["colmap"] > max(MAX_GAP_M, MAX_GAP_RATIO * gap.get("odometry", 0.0)):
        return f"overlapping depth images are {gap['colmap'] * 100:.1f} cm apart under its poses"
    return ""


def upright(
    clip: Clip,
    world_from_camera: Float[np.ndarray, "frame 4 4"],
    points_world: Float[np.ndarray, "point 3"],
    normals_world: Float[np.ndarray, "point 3"],
) -> tuple[Float[np.ndarray, "4 4"], str]:
    """Return ``upright_from_world`` with +y up, and the source of the up direction."""
    if clip.odometry_from_camera is not None and clip.gravity_known:
        odometry_from_camera = clip.odometry_from_camera[:, :3, :3]
        world_from_odometry = world_from_camera[:, :3, :3] @ np.swapaxes(odometry_from_camera, 1, 2)
        up, source = world_from_odometry[:, :, 1].mean(0), "gravity of the phone"
    else:
        guess = -world_from_camera[:, :3, 1].mean(0)
        up, source = ground.floor_direction(normals_world, guess / np.linalg.norm(guess)), "dominant planes"
    rotation = align.rotation_between(up, np.array([0.0, 1.0, 0.0]))
    return rigid.make(rotation, -rotation @ points_world.mean(0)), source
