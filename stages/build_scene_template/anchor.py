"""Anchor the walk-through in the world: metric scale from depth, a check by depth, bridging by odometry, gravity.

The sparse model is refuted when depth contradicts it; then the odometry is the start, and says so.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float, Int

from pipeline.files.clips import Clip
from pipeline.space import align, cameras, ground, rigid
from pipeline.space.sparse import Sparse
from stages.build_scene_template.matches import points_under
from stages.build_scene_template.refine import Keyframe


@dataclass(frozen=True)
class AnchorOptions:
    """When structure from motion is believed."""

    least_registered: float = 0.6
    """Share of the keyframes that must be in the largest model."""
    most_scale_spread: float = 0.06
    """Robust relative spread of depth over SfM depth beyond which the model is refuted."""
    most_gap_m: float = 0.06
    """Gap between overlapping depth images beyond which the model is refuted, metres ..."""
    most_gap_ratio: float = 1.5
    """... if it is also so many times the gap under the odometry."""


@dataclass(frozen=True)
class Trajectory:
    """A start for every frame: poses, where they came from, and what was measured about SfM."""

    world_from_camera: Float[np.ndarray, "frame 4 4"]
    source: Literal["colmap", "odometry"]
    reason: str
    registered: Int[np.ndarray, "key"]
    scale_spread: float | None
    """Robust relative standard deviation of depth over SfM depth."""
    odometry_scale: float | None
    """Length of the odometry's path over the model's, between neighbouring keyframes; 1 is agreement."""
    gap_m: dict[str, float]
    """Gap between overlapping depth images under each candidate trajectory (`depth_gap`)."""


def metric_scale(sparse: Sparse, clip: Clip) -> tuple[float, float] | None:
    """Return metres per model unit and its robust relative spread, from depth under the tracks; None without depth."""
    ratios = []
    for view, frame in enumerate(sparse.frame):
        row = np.flatnonzero(sparse.observed_key == view)
        measured = points_under(clip, int(frame), sparse.observed_pixel[row])[:, 2]
        model = rigid.apply(rigid.inverse(sparse.model_from_camera[view]), sparse.points_model[sparse.observed_point[row]])[:, 2]
        ratios.append((measured / model)[np.isfinite(measured) & (model > 0)])
    ratio = np.concatenate(ratios)
    if len(ratio) < 20:
        return None
    scale = float(np.median(ratio))
    return scale, float(1.4826 * np.median(np.abs(ratio - scale)) / scale)


def depth_gap(keyframes: list[Keyframe], world_from_camera: Float[np.ndarray, "key 4 4"]) -> float:
    """Return how far depth images of keyframes 1, 3 and 8 apart differ, metres: the mean of their 75 % quantiles."""
    gaps = []
    for hop in (1, 3, 8):
        for first in range(len(keyframes) - hop):
            moved = rigid.apply(
                rigid.inverse(world_from_camera[first + hop]) @ world_from_camera[first],
                keyframes[first].scan.points_camera,
            )
            target = keyframes[first + hop]
            pixel, z = cameras.project(moved, target.intrinsics)
            column, row = np.floor(pixel).astype(int).T
            inside = (z > 0.1) & (row >= 0) & (column >= 0) & (row < target.depth.shape[0]) & (column < target.depth.shape[1])
            met = target.depth[row[inside], column[inside]]
            gap = np.abs(met - z[inside])[met > 0]
            gaps.append(np.quantile(gap, 0.75) if len(gap) > 50 else np.nan)
    return float(np.nanmean(gaps)) if np.isfinite(gaps).any() else np.inf


def bridge(clip: Clip, frames: Int[np.ndarray, "key"], world_from_camera: Float[np.ndarray, "key 4 4"]) -> Float[np.ndarray, "frame 4 4"]:
    """Carry known frames to all frames: along the odometry from both known neighbours, blended; without odometry, in
    time.
    """
    time = clip.timestamp_s
    if clip.odometry_from_camera is None:
        return rigid.interpolate(time[frames], world_from_camera, time)
    odometry = clip.odometry_from_camera
    world_from_odometry = world_from_camera @ rigid.inverse(odometry[frames])
    after = (
        np.clip(np.searchsorted(frames, np.arange(len(time)), side="right"), 1, len(frames) - 1)
        if len(frames) > 1
        else np.zeros(len(time), int)
    )
    before = np.maximum(after - 1, 0)
    share = np.clip((time - time[frames[before]]) / np.maximum(time[frames[after]] - time[frames[before]], 1e-9), 0, 1)
    ends = [world_from_odometry[index] @ odometry for index in (before, after)]
    step = rigid.log(rigid.inverse(ends[0]) @ ends[1])
    return ends[0] @ rigid.exp(step * share[:, None])


def choose_start(
    clip: Clip, frames: Int[np.ndarray, "key"], keyframes: list[Keyframe], sparse: Sparse | None, options: AnchorOptions
) -> Trajectory | None:
    """Believe SfM if enough keyframes are in it, its scale is steady and depth agrees; otherwise take the odometry.

    None where there is neither.
    """
    odometry = clip.odometry_from_camera
    gap = {} if odometry is None else {"odometry": depth_gap(keyframes, odometry[frames])}
    spread = ratio = None
    poses, reason = None, "no model came out"
    measured = None if sparse is None else metric_scale(sparse, clip)
    if sparse is not None and measured is None:
        reason = "depth lies under too few of its points"
    elif sparse is not None:
        scale, spread = measured
        poses = sparse.model_from_camera.copy()
        poses[:, :3, 3] *= scale
        poses = bridge(clip, sparse.frame, poses)
        gap["colmap"] = depth_gap(keyframes, poses[frames])
        reason = _refutation(len(sparse.frame) / len(frames), spread, gap, options)
        if odometry is not None:
            step = [np.linalg.norm(np.diff(path[sparse.frame, :3, 3], axis=0), axis=1).sum() for path in (odometry, poses)]
            ratio = float(step[0] / max(step[1], 1e-9))
    registered = sparse.frame if sparse is not None else np.zeros(0, int)
    if poses is None and odometry is None:
        return None
    if poses is None or (reason and odometry is not None):
        return Trajectory(odometry, "odometry", reason, registered, spread, ratio, gap)
    return Trajectory(poses, "colmap", reason, registered, spread, ratio, gap)


def _refutation(registered, spread, gap, options):
    """Say in words why depth or coverage contradicts the sparse model; empty when nothing does."""
    if registered < options.least_registered:
        return f"only {registered:.0%} of the keyframes were registered"
    if spread > options.most_scale_spread:
        return f"its scale wavers by {spread:.1%} against depth"
    if gap["colmap"] > max(options.most_gap_m, options.most_gap_ratio * gap.get("odometry", 0.0)):
        return f"overlapping depth images are {gap['colmap'] * 100:.1f} cm apart under its poses"
    return ""


def upright(
    clip: Clip,
    world_from_camera: Float[np.ndarray, "frame 4 4"],
    points_world: Float[np.ndarray, "point 3"],
    normals_world: Float[np.ndarray, "point 3"],
) -> tuple[Float[np.ndarray, "4 4"], str]:
    """Return ``upright_from_world`` that turns +y up, and how up was found: the phone's gravity, or the dominant
    planes.
    """
    if clip.odometry_from_camera is not None and clip.gravity_known:
        up = (world_from_camera[:, :3, :3] @ np.swapaxes(clip.odometry_from_camera[:, :3, :3], 1, 2))[:, :, 1].mean(0)
        how = "gravity of the phone"
    else:
        guess = -world_from_camera[:, :3, 1].mean(0)
        up, how = ground.floor_direction(normals_world, guess / np.linalg.norm(guess)), "dominant planes"
    rotation = align.rotation_between(up, np.array([0.0, 1.0, 0.0]))
    return rigid.make(rotation, -rotation @ points_world.mean(0)), how
