"""Detect moving objects: points of one frame in free space of others, clustered to an animal's size.

Device poses must be usable. This is a quick check, not a mask: an animal that never moves is missed.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float

from pipeline.geometry import cameras, rigid
from stages.check_captures.sampling import SampledFrame

MARGIN_M, MARGIN_SHARE = 0.12, 0.03
"""a point is in another frame's free space if depth there is larger by this, meters and share of depth"""
ANIMAL_M2 = (0.006, 0.6)
"""smallest and largest visible surface of an animal, square meters"""
LARGE_M2 = 0.1
"""visible moving surface of a person or a large animal, square meters; drift and noise of walk-throughs whose
parts agree stay below, and so does a cat"""
TWO_APART_M = 0.6
"""clusters further apart than this are two animals, meters"""
VOTES = 2
AROUND = np.ones((3, 3), np.uint8)


@dataclass(frozen=True)
class MotionShare:
    """Moving objects in a recording."""

    seen: float
    """share of frames (0..1) with a moving object of an animal's size"""
    several: float
    """share of frames with two such objects far apart"""
    large: float
    """share of frames in which something larger than `LARGE_M2` moves"""


def find_motion(shots: Sequence[SampledFrame]) -> MotionShare | None:
    """Find moving objects in sampled frames; None without device poses."""
    if len(shots) < 4 or shots[0].odometry_from_camera is None:
        return None
    clusters = [_clusters(shot, _moved(shot, shots)) for shot in shots]
    animals = [[at for at, area in found if ANIMAL_M2[0] < area < ANIMAL_M2[1]] for found in clusters]
    seen = float(np.mean([bool(found) for found in animals]))
    apart = [[np.linalg.norm(a - b) for a, b in itertools.combinations(found, 2)] for found in animals]
    several = float(np.mean([float(max(each, default=0.0)) > TWO_APART_M for each in apart]))
    large = float(np.mean([any(area > LARGE_M2 for _, area in found) for found in clusters]))
    return MotionShare(seen, several, large)


def _moved(shot: SampledFrame, others: Sequence[SampledFrame]) -> Bool[np.ndarray, "height width"]:
    """Return pixels whose points are in free space of at least two other frames, and on fewer surfaces."""
    points_camera = cameras.back_project(shot.depth, shot.depth_intrinsics).reshape(-1, 3)
    points = rigid.apply(rigid.inverse(shot.camera_from_odometry), points_camera)
    free, occupied = np.zeros(len(points), int), np.zeros(len(points), int)
    for other in (each for each in others if each is not shot):
        points_other = rigid.apply(other.camera_from_odometry, points)
        pixel, z = cameras.project(points_other, other.depth_intrinsics)
        # 0 beside unknown pixels and the border
        low = cv2.erode(other.depth, AROUND, borderType=cv2.BORDER_CONSTANT, borderValue=0)
        low, high = (cameras.sample_nearest(each, pixel) for each in (low, cv2.dilate(other.depth, AROUND)))
        known, margin = (low > 0) & (z > 0.1), MARGIN_M + MARGIN_SHARE * z
        free += known & (low > z + margin)
        occupied += known & (low < z + margin) & (high > z - margin)
    marked = ((free >= VOTES) & (free > occupied)).reshape(shot.depth.shape) & (shot.depth > 0)
    return cv2.morphologyEx(marked.astype(np.uint8), cv2.MORPH_OPEN, AROUND) > 0


def _clusters(
    shot: SampledFrame, marked: Bool[np.ndarray, "height width"]
) -> list[tuple[Float[np.ndarray, "3"], float]]:
    """Return the centers (camera axes, meters) and surfaces (square meters) of connected regions."""
    count, labels = cv2.connectedComponents(marked.astype(np.uint8), connectivity=8)
    points = cameras.back_project(shot.depth, shot.depth_intrinsics)
    area = shot.depth**2 / (shot.depth_intrinsics[0, 0] * shot.depth_intrinsics[1, 1])
    regions = [labels == label for label in range(1, count)]
    return [(np.median(points[region], axis=0), float(area[region].sum())) for region in regions]
