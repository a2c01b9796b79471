"""Camera poses around the standing animal: drift-corrected odometry with loop closure."""

from dataclasses import dataclass
from functools import partial

import numpy as np
from jaxtyping import Float, UInt8

from pipeline.core.errors import InputError
from pipeline.data.clips import Clip, Masks, usable_depth
from pipeline.geometry import rigid
from pipeline.geometry.ground import GroundPlane, fit_ground
from pipeline.mapping.icp import depth_views
from pipeline.mapping.odometry import CorrectedOdometry, Guess, align_gravity, chain_alignments, correct_drift

STRIDE = 2
LOOPS = 5
"""earlier views that each keyframe is aligned to: an orbit sees the same place often"""
GROUND_FRAMES, REACH_M = 40, 0.4
"""frames used for the ground, and its radius around the animal"""
LEVEL_COSINE = 0.9
"""ground normals are within 26 degrees of vertical"""
MIN_POINTS = 200
"""least depth points on animal and on ground, over about 40 frames at that stride"""


@dataclass(frozen=True)
class Turnaround:
    """The turnaround in a world of its own, +y up, with the ground the animal stands on."""

    world_from_camera: Float[np.ndarray, "frame 4 4"]
    ground: GroundPlane
    odometry_fit: CorrectedOdometry


def register_turnaround(clip: Clip, masks: Masks) -> Turnaround:
    """Register all cameras by the whole static scene, animal included, and fit the ground around it.

    Raises InputError AGT-001 if hardly any depth was measured on the animal, or on a level surface.
    """
    view = depth_views(partial(usable_depth, clip), clip.depth_intrinsics, STRIDE)
    odometry = clip.odometry_from_camera
    if odometry is None:
        odometry = chain_alignments(view, lambda _, last: Guess(last), len(clip))
    odometry_fit = correct_drift(view, clip.timestamp_s, odometry, loops=LOOPS)
    poses = odometry_fit.world_from_camera
    if clip.odometry_from_camera is None or not clip.gravity_known:
        poses = align_gravity(view, poses)
    animal, floor = [], []
    for frame in np.flatnonzero(masks.visible)[:: max(1, int(masks.visible.sum()) // GROUND_FRAMES)]:
        seen = view(frame)
        label = depth_labels(masks[frame], clip.depth_size)[STRIDE // 2 :: STRIDE, STRIDE // 2 :: STRIDE]
        points = rigid.apply(poses[frame], seen.points.astype(float))
        up = seen.normals @ poses[frame, 1, :3]
        known = seen.points[..., 2] > 0
        animal.append(points[known & (label == 255)])
        floor.append(points[known & (label == 0) & (up > LEVEL_COSINE)])
    on_animal, on_floor = np.concatenate(animal), np.concatenate(floor)
    if min(len(on_animal), len(on_floor)) < MIN_POINTS:
        what = f"only {len(on_animal)} depth points lie on the animal and {len(on_floor)} on level ground"
        remedy = "circle it from 1.2 m, in light, with the floor in view; sensors miss what is black or wet"
        raise InputError("AGT-001", what, str(masks.folder), remedy)
    ground = fit_ground(on_floor, np.median(on_animal, axis=0), reach_m=REACH_M)
    return Turnaround(poses, ground, odometry_fit)


def depth_labels(
    labels: UInt8[np.ndarray, "height width"], size: tuple[int, int]
) -> UInt8[np.ndarray, "depth_height depth_width"]:
    """Sample a mask (color resolution) at the centers of the depth pixels."""
    rows = ((np.arange(size[0]) + 0.5) * labels.shape[0] / size[0]).astype(int)
    columns = ((np.arange(size[1]) + 0.5) * labels.shape[1] / size[1]).astype(int)
    return labels[rows[:, None], columns]
