"""Whether something moves: points of one frame that others saw through, in clumps of an animal's size.

Device poses must be usable. A quick look, not a mask: an animal that rests all the time is missed.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float

from pipeline.geometry import cameras, rigid
from stages.check_captures.sampling import SampledFrame

THROUGH_M, THROUGH_SHARE = 0.12, 0.03
"""a point that another frame saw this far through, metres and share of its depth, was not there then"""
CLUMP_M2 = (0.006, 0.6)
"""smallest and largest visible surface of an animal, square metres"""
TWO_APART_M = 0.6
"""clumps further apart than this are two animals, metres"""
VOTES = 2


@dataclass(frozen=True)
class MotionShare:
    """What moves in a recording."""

    seen: float
    """share of frames (0..1) in which something of an animal's size moves"""
    several: float
    """share of frames in which two such things move far apart"""


def find_motion(shots: Sequence[SampledFrame]) -> MotionShare | None:
    """Find moving things in sampled frames; None where device poses are missing."""
    if len(shots) < 4 or shots[0].odometry_from_camera is None:
        return None
    clumps = [_clumps(shot, _vanished(shot, shots)) for shot in shots]
    seen = float(np.mean([bool(found) for found in clumps]))
    several = float(np.mean([_far_apart(found) for found in clumps]))
    return MotionShare(seen, several)


def _vanished(shot: SampledFrame, others: Sequence[SampledFrame]) -> Bool[np.ndarray, "height width"]:
    """Mark pixels whose points at least two other frames saw through, and fewer saw in place."""
    points_camera = cameras.back_project(shot.depth, shot.depth_intrinsics).reshape(-1, 3)
    points = rigid.apply(rigid.inverse(shot.camera_from_odometry), points_camera)
    through, there = np.zeros(len(points), int), np.zeros(len(points), int)
    for other in (each for each in others if each is not shot):
        points_other = rigid.apply(other.camera_from_odometry, points)
        pixel, depth = cameras.project(points_other, other.depth_intrinsics)
        height, width = other.depth.shape
        inside = (depth > 0.1) & (pixel >= 1).all(-1) & (pixel[:, 0] < width - 1) & (pixel[:, 1] < height - 1)
        column, row = np.floor(pixel[inside]).astype(int).T
        low, high = _range_around(other.depth)
        margin = THROUGH_M + THROUGH_SHARE * depth[inside]
        measured = low[row, column]
        beyond = measured > depth[inside] + margin
        before = high[row, column] <= depth[inside] - margin
        through[inside] += beyond & (measured > 0)
        there[inside] += ~before & (measured < depth[inside] + margin) & (measured > 0)
    marked = ((through >= VOTES) & (through > there)).reshape(shot.depth.shape) & (shot.depth > 0)
    return cv2.morphologyEx(marked.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)) > 0


def _range_around(depth: Float[np.ndarray, "height width"]) -> tuple[np.ndarray, np.ndarray]:
    """Return the smallest and largest depth around each pixel; an unknown one makes the smallest 0."""
    ones = np.ones((3, 3), np.uint8)
    return cv2.erode(depth, ones), cv2.dilate(depth, ones)


def _clumps(shot: SampledFrame, marked: Bool[np.ndarray, "height width"]) -> list[Float[np.ndarray, "3"]]:
    """Return the centres (camera axes, metres) of marked regions of an animal's size."""
    count, labels = cv2.connectedComponents(marked.astype(np.uint8), connectivity=8)
    points = cameras.back_project(shot.depth, shot.depth_intrinsics)
    area = shot.depth**2 / (shot.depth_intrinsics[0, 0] * shot.depth_intrinsics[1, 1])
    found = []
    for label in range(1, count):
        region = labels == label
        if CLUMP_M2[0] < float(area[region].sum()) < CLUMP_M2[1]:
            found.append(np.median(points[region], axis=0))
    return found


def _far_apart(centres: Sequence[Float[np.ndarray, "3"]]) -> bool:
    return any(np.linalg.norm(a - b) > TWO_APART_M for i, a in enumerate(centres) for b in centres[i + 1 :])
