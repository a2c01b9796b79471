"""Anchor the walk-through in the world: metric scale from depth, a check by depth, propagation by odometry,
gravity.

The sparse model is refuted when depth contradicts it; then odometry is the initial trajectory.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from pipeline.data.clips import Clip
from pipeline.geometry import align, cameras, ground, rigid
from pipeline.mapping.colmap import SparseModel
from stages.build_scene_template.matches import points_under
from stages.build_scene_template.refine import Keyframe

LEAST_REGISTERED = 0.6
"""Share of the keyframes that must be in the largest model; with less, odometry explains more of the walk."""
MOST_SCALE_DEVIATION = 0.06
"""Robust relative deviation of depth over SfM depth beyond which the model is refuted; sound models have 1-3
%."""
MOST_GAP_M, MOST_GAP_RATIO = 0.06, 1.5
"""Gap between overlapping depth images beyond which the model is refuted, metres, if it is also so many times
the gap under the odometry."""
LEAST_RATIOS = 20
"""Tracks with depth below which there is no scale."""
MAD_TO_SIGMA = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""
HOPS = (1, 3, 8)
"""Keyframes that many apart have their depth images compared."""
GAP_QUANTILE, LEAST_OVERLAP = 0.75, 50
"""Quantile of a pair's gaps that counts, and least number of overlapping points of a pair."""
NEAREST_M = 0.1
"""Depth below this is none, metres."""


@dataclass(frozen=True)
class InitialTrajectory:
    """Initial poses of every frame, their source, and what was measured about SfM."""

    world_from_camera: Float[np.ndarray, "frame 4 4"]
    source: Literal["colmap", "odometry"]
    reason: str
    """Why SfM is not believed; empty where it is."""
    registered: Int[np.ndarray, "key"]
    scale_deviation: float | None
    """Robust relative standard deviation of depth over SfM depth."""
    odometry_scale: float | None
    """Length of the odometry's path over the model's, between neighbouring keyframes; 1 is agreement."""
    gap_m: dict[str, float]
    """Gap between overlapping depth images under each candidate trajectory (`depth_gap`)."""


def metric_scale(sparse: SparseModel, clip: Clip) -> tuple[float, float] | None:
    """Return metres per model unit and its robust relative deviation, from depth under the tracks; None
    without depth."""
    ratios = []
    for view, frame in enumerate(sparse.frame):
        row = np.flatnonzero(sparse.observed_key == view)
        measured = points_under(clip, int(frame), sparse.observed_pixel[row])[:, 2]
        model = rigid.apply(
            rigid.inverse(sparse.model_from_camera[view]), sparse.points_model[sparse.observed_point[row]]
        )[:, 2]
        ratios.append((measured / model)[np.isfinite(measured) & (model > 0)])
    ratio = np.concatenate(ratios)
    if len(ratio) < LEAST_RATIOS:
        return None
    scale = float(np.median(ratio))
    return scale, float(MAD_TO_SIGMA * np.median(np.abs(ratio - scale)) / scale)


def depth_gap(keyframes: list[Keyframe], world_from_camera: Float[np.ndarray, "key 4 4"]) -> float:
    """Return how far depth images of keyframes 1, 3 and 8 apart differ, metres: the mean of their 75 %
    quantiles."""
    gaps = []
    for hop in HOPS:
        for first in range(len(keyframes) - hop):
            moved = rigid.apply(
                rigid.inverse(world_from_camera[first + hop]) @ world_from_camera[first],
                keyframes[first].scan.points_camera,
            )
            target = keyframes[first + hop]
            pixel, z = cameras.project(moved, target.intrinsics)
            column, row = np.floor(pixel).astype(int).T
            inside = (
                (z > NEAREST_M)
                & (row >= 0)
                & (column >= 0)
                & (row < target.depth.shape[0])
                & (column < target.depth.shape[1])
            )
            measured = target.depth[row[inside], column[inside]]
            gap = np.abs(measured - z[inside])[measured > 0]
            gaps.append(np.quantile(gap, GAP_QUANTILE) if len(gap) > LEAST_OVERLAP else np.nan)
    return float(np.nanmean(gaps)) if np.isfinite(gaps).any() else np.inf


def propagate(
    clip: Clip, frames: Int[np.ndarray, "key"], world_from_camera: Float[np.ndarray, "key 4 4"]
) -> Float[np.ndarray, "frame 4 4"]:
    """Propagate keyframe poses to all frames: along odometry from both neighbouring keyframes, blended; else
    in time."""
    time = clip.timestamp_s
    if clip.odometry_from_camera is None:
        return rigid.interpolate(time[frames], world_from_camera, time)
    odometry = clip.odometry_from_camera
    world_from_odometry = world_from_camera @ rigid.inverse(odometry[frames])
    if len(frames) > 1:
        after = np.clip(np.searchsorted(frames, np.arange(len(time)), side="right"), 1, len(frames) - 1)
    else:
        after = np.zeros(len(time), int)
    before = np.maximum(after - 1, 0)
    blend = np.clip(
        (time - time[frames[before]]) / np.maximum(time[frames[after]] - time[frames[before]], 1e-9), 0, 1
    )
    ends = [world_from_odometry[index] @ odometry for index in (before, after)]
    step = rigid.log(rigid.inverse(ends[0]) @ ends[1])
    return ends[0] @ rigid.exp(step * blend[:, None])


def choose_start(
    clip: Clip, frames: Int[np.ndarray, "key"], keyframes: list[Keyframe], sparse: SparseModel | None
) -> InitialTrajectory | None:
    """Return SfM poses if enough keyframes are registered, their scale is steady and depth agrees; else the
    odometry.

    None where there is neither.
    """
    odometry = clip.odometry_from_camera
    gap = {} if odometry is None else {"odometry": depth_gap(keyframes, odometry[frames])}
    deviation = ratio = None
    poses, reason = None, "no model came out"
    measured = None if sparse is None else metric_scale(sparse, clip)
    if sparse is not None and measured is None:
        reason = "depth lies under too few of its points"
    elif sparse is not None and measured is not None:
        scale, deviation = measured
        poses = sparse.model_from_camera.copy()
        poses[:, :3, 3] *= scale
        poses = propagate(clip, sparse.frame, poses)
        gap["colmap"] = depth_gap(keyframes, poses[frames])
        reason = _refutation(len(sparse.frame) / len(frames), deviation, gap)
        if odometry is not None:
            step = [
                np.linalg.norm(np.diff(path[sparse.frame, :3, 3], axis=0), axis=1).sum()
                for path in (odometry, poses)
            ]
            ratio = float(step[0] / max(step[1], 1e-9))
    registered = sparse.frame if sparse is not None else np.zeros(0, int)
    if odometry is not None and (poses is None or reason):
        return InitialTrajectory(odometry, "odometry", reason, registered, deviation, ratio, gap)
    if poses is None:
        return None
    return InitialTrajectory(poses, "colmap", reason, registered, deviation, ratio, gap)


def _refutation(registered, deviation, gap):
    """Return why depth or coverage contradicts the sparse model; empty when nothing does."""
    if registered < LEAST_REGISTERED:
        return f"only {registered:.0%} of the keyframes were registered"
    if deviation > MOST_SCALE_DEVIATION:
        return f"its scale varies by {deviation:.1%} against depth"
    if gap["colmap"] > max(MOST_GAP_M, MOST_GAP_RATIO * gap.get("odometry", 0.0)):
        return f"overlapping depth images are {gap['colmap'] * 100:.1f} cm apart under its poses"
    return ""


def upright(
    clip: Clip,
    world_from_camera: Float[np.ndarray, "frame 4 4"],
    points_world: Float[np.ndarray, "point 3"],
    normals_world: Float[np.ndarray, "point 3"],
) -> tuple[Float[np.ndarray, "4 4"], str]:
    """Return ``upright_from_world`` that turns +y up, and the source of up: the phone's gravity or the
    dominant planes.
    """
    if clip.odometry_from_camera is not None and clip.gravity_known:
        up = (world_from_camera[:, :3, :3] @ np.swapaxes(clip.odometry_from_camera[:, :3, :3], 1, 2))[
            :, :, 1
        ].mean(0)
        how = "gravity of the phone"
    else:
        guess = -world_from_camera[:, :3, 1].mean(0)
        up, how = ground.floor_direction(normals_world, guess / np.linalg.norm(guess)), "dominant planes"
    rotation = align.rotation_between(up, np.array([0.0, 1.0, 0.0]))
    return rigid.make(rotation, -rotation @ points_world.mean(0)), how
