"""Camera trajectory: drift-corrected odometry, or motion from depth and flow without odometry."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float

from pipeline.data.clips import Clip, back_project_pixels, usable_depth
from pipeline.data.flow import STRIDE_PX, open_flow
from pipeline.geometry import cameras, rigid
from pipeline.geometry.align import ransac_rigid
from pipeline.mapping.icp import depth_views
from pipeline.mapping.odometry import Guess, align_gravity, chain_alignments, correct_drift

DEPTH_STRIDE = 3
INLIER_M, ITERATIONS = 0.03, 200
"""RANSAC over flow correspondences: inlier threshold and iterations"""
AGREEING = 0.9
"""least inliers of ICP's motion, share of those of flow's: ICP follows what is close, such as an animal"""


@dataclass(frozen=True)
class CameraPath:
    """Camera poses in a world of the recording's own, +y up."""

    world_from_camera: Float[np.ndarray, "frame 4 4"]
    alignments: int
    residual_m: float


def estimate_trajectory(clip: Clip, flow: Path, rng: np.random.Generator) -> CameraPath:
    """Return drift-corrected poses; without odometry, frame-to-frame motion is chained first."""
    view = depth_views(partial(usable_depth, clip, keep_steps=False), clip.depth_intrinsics, DEPTH_STRIDE)
    poses = clip.odometry_from_camera
    if poses is None:
        forward = open_flow(flow, 1)
        poses = chain_alignments(
            view, lambda frame, _: motion_from_flow(clip, frame, forward[frame], rng), len(clip)
        )
    found = correct_drift(view, clip.timestamp_s, poses)
    level_known = clip.odometry_from_camera is not None and clip.gravity_known
    poses = found.world_from_camera if level_known else align_gravity(view, found.world_from_camera)
    return CameraPath(poses, found.edges, found.residual_m)


def motion_from_flow(
    clip: Clip, frame: int, flow: Float[np.ndarray, "height width 2"], rng: np.random.Generator
) -> Guess:
    """Return the motion between a frame and the next, by RANSAC on flow and depth."""
    height, width = flow.shape[:2]
    pixel = cameras.pixel_grid(height, width) * STRIDE_PX
    first, second = (
        back_project_pixels(clip, row, at.reshape(-1, 2), usable_depth(clip, row, keep_steps=False))
        for row, at in ((frame, pixel), (frame + 1, pixel + flow))
    )
    known = np.isfinite(first[:, 0]) & np.isfinite(second[:, 0])
    first, second = first[known], second[known]
    motion, inlier = ransac_rigid(second, first, threshold_m=INLIER_M, iterations=ITERATIONS, rng=rng)

    def agrees(aligned: Float[np.ndarray, "4 4"]) -> bool:
        apart_m = np.linalg.norm(rigid.apply(aligned, second) - first, axis=-1)
        return bool((apart_m < INLIER_M).sum() >= AGREEING * inlier.sum())

    return Guess(motion, agrees)
