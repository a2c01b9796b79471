"""Where the phone was around the standing animal: odometry without drift, the circle closed."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8

from pipeline.files.clips import Clip, Masks
from pipeline.space import rigid
from pipeline.space.depth_alignment import DepthView, depth_view
from pipeline.space.ground import Ground, fit_ground
from pipeline.space.straightening import Straightened, Straightening, chain, level, straighten

STRIDE = 2


@dataclass(frozen=True)
class Circle:
    """The turnaround in a world of its own, +y up, with the ground the animal stands on."""

    world_from_camera: Float[np.ndarray, "frame 4 4"]
    ground: Ground
    straightened: Straightened


def walk_around(clip: Clip, masks: Masks, options: Straightening) -> Circle:
    """Place all cameras by the whole still scene, the animal included; the ground is the level surface around it."""

    def view(frame: int) -> DepthView:
        return depth_view(clip.depth(frame), clip.depth_intrinsics[frame], clip.confidence(frame) > 0, STRIDE)

    odometry = clip.odometry_from_camera
    if odometry is None:
        odometry = chain(view, lambda _, last: last, len(clip), options)
    straightened = straighten(view, odometry, options)
    poses = straightened.world_from_camera
    if clip.odometry_from_camera is None or not clip.gravity_known:
        poses = level(view, poses)
    animal, floor = [], []
    for frame in np.flatnonzero(masks.visible)[:: max(1, int(masks.visible.sum()) // 40)]:
        seen = view(frame)
        label = depth_labels(masks[frame], clip.depth_size)[STRIDE // 2 :: STRIDE, STRIDE // 2 :: STRIDE]
        points = rigid.apply(poses[frame], seen.points.reshape(-1, 3).astype(float)).reshape(seen.points.shape)
        up = seen.normals @ poses[frame, 1, :3]
        known = seen.points[..., 2] > 0
        animal.append(points[known & (label == 255)])
        floor.append(points[known & (label == 0) & (up > 0.9)])
    middle = np.median(np.concatenate(animal), axis=0)
    return Circle(poses, fit_ground(np.concatenate(floor), middle, reach_m=0.4), straightened)


def depth_labels(labels: UInt8[np.ndarray, "height width"], size: tuple[int, int]) -> UInt8[np.ndarray, "depth_height depth_width"]:
    """Sample a mask (colour resolution) at the centres of the depth pixels."""
    rows = ((np.arange(size[0]) + 0.5) * labels.shape[0] / size[0]).astype(int)
    columns = ((np.arange(size[1]) + 0.5) * labels.shape[1] / size[1]).astype(int)
    return labels[rows[:, None], columns]
