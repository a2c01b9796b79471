"""Camera trajectory: drift-corrected odometry, or motion from depth and flow without odometry."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from pipeline.data.clips import Clip, back_project_pixels, usable_depth
from pipeline.data.flow import STRIDE_PX, open_flow
from pipeline.geometry import cameras, rigid
from pipeline.geometry.align import ransac_rigid
from pipeline.mapping.icp import depth_views
from pipeline.mapping.odometry import Guess, align_gravity, chain_alignments, correct_drift
from stages.segment_agent import free_space, movers

DEPTH_STRIDE = 3
INLIER_M, ITERATIONS = 0.03, 200
"""RANSAC over flow correspondences: inlier threshold and iterations"""
AGREEING = 0.9
"""least inliers of ICP's motion, share of those of flow's: ICP follows what is close, such as an animal"""
MOVING_STRIDE = 4
"""stride of depth samples that are tested for motion, pixels"""
OPENING, DILATION = np.ones((2, 2), np.uint8), np.ones((5, 5), np.uint8)
"""opening and dilation of what moves, samples"""

DepthOf = Callable[[int], Float[np.ndarray, "height width"]]
"""depth of one frame, meters, 0 where unknown"""


@dataclass(frozen=True)
class CameraPath:
    """Camera poses in a world of the recording's own, +y up."""

    world_from_camera: Float[np.ndarray, "frame 4 4"]
    alignments: int
    residual_m: float


def estimate_trajectory(
    clip: Clip, flow: Path, rng: np.random.Generator, depth_of: DepthOf | None = None
) -> CameraPath:
    """Return drift-corrected poses; without odometry, frame-to-frame motion is chained first.

    ``depth_of`` is the depth that is aligned; by default all that is usable.
    """
    depth_of = depth_of or partial(usable_depth, clip, keep_steps=False)
    view = depth_views(depth_of, clip.depth_intrinsics, DEPTH_STRIDE)
    poses = clip.odometry_from_camera
    if poses is None:
        forward = open_flow(flow, 1)
        poses = chain_alignments(
            view, lambda frame, _: motion_from_flow(clip, frame, forward[frame], rng, depth_of), len(clip)
        )
    found = correct_drift(view, clip.timestamp_s, poses)
    level_known = clip.odometry_from_camera is not None and clip.gravity_known
    poses = found.world_from_camera if level_known else align_gravity(view, found.world_from_camera)
    return CameraPath(poses, found.edges, found.residual_m)


def estimate_without_movers(clip: Clip, flow: Path, references: int, seed: int) -> CameraPath:
    """Estimate poses, and again without what moves by the first ones: several animals cover much.

    Once where the device has odometry, which does not depend on what is in view. ``references`` depth
    pictures vote on what moves.
    """
    path = estimate_trajectory(clip, flow, np.random.default_rng(seed))
    if clip.odometry_from_camera is not None:
        return path
    poses = path.world_from_camera
    voting = free_space.gather(clip, poses, references)

    @cache
    def near_movers(frame: int) -> UInt8[np.ndarray, "row column"]:
        depth = usable_depth(clip, frame, keep_steps=False)
        points = free_space.world_points(clip, frame, poses[frame], depth, MOVING_STRIDE)
        moving = movers.moving(free_space.vote(voting, points, frame)).astype(np.uint8)
        return cv2.dilate(cv2.erode(moving, OPENING), DILATION)

    def static_depth(frame: int) -> Float[np.ndarray, "height width"]:
        near = cv2.resize(near_movers(frame), clip.depth_size[::-1], interpolation=cv2.INTER_NEAREST)
        return np.where(near > 0, 0, usable_depth(clip, frame, keep_steps=False))

    return estimate_trajectory(clip, flow, np.random.default_rng(seed), static_depth)


def motion_from_flow(
    clip: Clip,
    frame: int,
    flow: Float[np.ndarray, "height width 2"],
    rng: np.random.Generator,
    depth_of: DepthOf,
) -> Guess:
    """Return the motion between a frame and the next, by RANSAC on flow and depth."""
    height, width = flow.shape[:2]
    pixel = cameras.pixel_grid(height, width) * STRIDE_PX
    first, second = (
        back_project_pixels(clip, row, at.reshape(-1, 2), depth_of(row))
        for row, at in ((frame, pixel), (frame + 1, pixel + flow))
    )
    known = np.isfinite(first[:, 0]) & np.isfinite(second[:, 0])
    first, second = first[known], second[known]
    first_from_second, inlier = ransac_rigid(
        second, first, threshold_m=INLIER_M, iterations=ITERATIONS, rng=rng
    )

    def agrees(motion: Float[np.ndarray, "4 4"]) -> bool:
        apart_m = np.linalg.norm(rigid.apply(motion, second) - first, axis=-1)
        return bool((apart_m < INLIER_M).sum() >= AGREEING * inlier.sum())

    return Guess(first_from_second, agrees)
