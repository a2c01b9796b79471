"""Camera trajectory: drift-corrected odometry, or motion from depth and flow without odometry."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from pipeline.data.clips import Clip, back_project_pixels, usable_depth
from pipeline.data.flow import STRIDE_PX, open_confidence, open_flow
from pipeline.geometry import cameras, rigid
from pipeline.geometry.align import ransac_rigid
from pipeline.mapping.icp import depth_views
from pipeline.mapping.odometry import Guess, align_gravity, chain_alignments, correct_drift

DEPTH_STRIDE = 3
INLIER_M, ITERATIONS = 0.03, 200
"""RANSAC over flow correspondences: inlier threshold and iterations"""
AGREEING, CERTAIN = 0.9, 128
"""least inliers of ICP's motion, which follows a close animal, share of flow's; confidence of that flow"""


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
        forward, certainty = open_flow(flow, 1), open_confidence(flow, 1)
        poses = chain_alignments(
            view, lambda i, _: motion_from_flow(clip, i, forward[i], certainty[i], rng), len(clip)
        )
    found = correct_drift(view, clip.timestamp_s, poses)
    level_known = clip.odometry_from_camera is not None and clip.gravity_known
    poses = found.world_from_camera if level_known else align_gravity(view, found.world_from_camera)
    return CameraPath(poses, found.edges, found.residual_m)


def motion_from_flow(
    clip: Clip,
    frame: int,
    flow: Float[np.ndarray, "height width 2"],
    confidence: UInt8[np.ndarray, "height width"],
    rng: np.random.Generator,
) -> Guess:
    """Return the motion to the next frame, by RANSAC on flow and depth; certain flow refutes others."""
    pixel = cameras.pixel_grid(*flow.shape[:2]) * STRIDE_PX
    first, second = (
        back_project_pixels(clip, row, at.reshape(-1, 2), usable_depth(clip, row, keep_steps=False))
        for row, at in ((frame, pixel), (frame + 1, pixel + flow))
    )
    known = np.isfinite(first[:, 0]) & np.isfinite(second[:, 0])
    first, second, certain = first[known], second[known], confidence.ravel()[known] >= CERTAIN
    motion, inlier = ransac_rigid(second, first, threshold_m=INLIER_M, iterations=ITERATIONS, rng=rng)

    def agrees(aligned: Float[np.ndarray, "4 4"]) -> bool:
        apart_m = np.linalg.norm(rigid.apply(aligned, second) - first, axis=-1)
        return bool((apart_m < INLIER_M)[certain].sum() >= AGREEING * inlier[certain].sum())

    return Guess(motion, agrees)
