"""Landmarks: SIFT keypoints of the walk-through with their world points.

`build` describes keyframes of the walk-through and casts each keypoint onto the scene's surface;
`Landmarks.match` pairs the keypoints of another picture of the room with points of the world.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from pipeline.core.progress import track
from pipeline.data.clips import Clip
from pipeline.data.templates import SceneCameras
from pipeline.geometry import cameras, subsampling
from pipeline.geometry.meshes import RayCaster
from pipeline.mapping import sift
from pipeline.mapping.sift import Keypoints

KEYFRAMES, POINTS = 80, 1200
"""Largest number of keyframes of the walk-through, and of keypoints per picture."""
PEAK_THRESHOLD = 0.02
"""SIFT's contrast threshold; plain walls need a low one (OpenCV's default is 0.04)."""
RETRIEVED_KEYFRAMES = 6
"""Keyframes that a picture is matched with: those with most of its nearest descriptors."""
TREES, CHECKS = 4, 32
"""FLANN: number of randomized k-d trees, and of leaves searched."""
INDEX_KDTREE = 1
"""FLANN's name for randomized k-d trees."""


@dataclass(frozen=True)
class Matches:
    """2D-3D correspondences: pixels of one picture and world points."""

    pixel: Float[np.ndarray, "match 2"]
    points_world: Float[np.ndarray, "match 3"]


def describe(color: UInt8[np.ndarray, "height width 3"]) -> Keypoints:
    """Detect and describe the strongest keypoints of a picture."""
    return sift.describe(cv2.cvtColor(color, cv2.COLOR_RGB2GRAY), POINTS, PEAK_THRESHOLD)


class Landmarks:
    """Keyframes of the walk-through with descriptors and world points of their keypoints."""

    def __init__(self, keyframes: list[tuple[Keypoints, Float[np.ndarray, "point 3"]]]):
        self.keyframes = keyframes
        self._owner = np.repeat(np.arange(len(keyframes)), [len(each.pixel) for each, _ in keyframes])
        cv2.setRNGSeed(0)
        self._index = cv2.FlannBasedMatcher({"algorithm": INDEX_KDTREE, "trees": TREES}, {"checks": CHECKS})
        self._index.add([np.concatenate([each.descriptors for each, _ in keyframes])])
        self._index.train()

    def match(self, keypoints: Keypoints) -> Matches:
        """Match a picture with the keyframes that have most of its nearest descriptors."""
        if not len(keypoints.pixel):
            return Matches(np.zeros((0, 2)), np.zeros((0, 3)))
        nearest = [each.trainIdx for each in self._index.match(keypoints.descriptors)]
        votes = np.bincount(self._owner[nearest], minlength=len(self.keyframes))
        pixel, points = [], []
        for keyframe in np.argsort(-votes, kind="stable")[:RETRIEVED_KEYFRAMES]:
            known, points_world = self.keyframes[keyframe]
            query, train = sift.matches(keypoints.descriptors, known.descriptors).T
            pixel.append(keypoints.pixel[query])
            points.append(points_world[train])
        return Matches(np.concatenate(pixel), np.concatenate(points))


def build(walk: Clip, walk_cameras: SceneCameras, caster: RayCaster) -> Landmarks:
    """Describe registered keyframes spread evenly over the walk-through."""
    keyframes = []
    for frame in track(keyframe_numbers(walk_cameras).tolist(), "landmarks"):
        found = describe(walk.color(frame))
        pose = walk_cameras.world_from_camera[frame]
        points = on_surface(found.pixel, walk.intrinsics[frame], pose, caster)
        hit = np.isfinite(points[:, 0])
        keyframes.append((Keypoints(found.pixel[hit], found.descriptors[hit]), points[hit]))
    return Landmarks(keyframes)


def keyframe_numbers(walk_cameras: SceneCameras) -> Int[np.ndarray, "keyframe"]:
    """Choose the keyframes of the walk-through."""
    return subsampling.some(np.flatnonzero(walk_cameras.registered), KEYFRAMES)


def on_surface(
    pixel: Float[np.ndarray, "point 2"],
    intrinsics: Float[np.ndarray, "3 3"],
    world_from_camera: Float[np.ndarray, "4 4"],
    caster: RayCaster,
) -> Float[np.ndarray, "point 3"]:
    """Intersect the rays of pixels with the surface: world points, NaN where nothing is hit."""
    direction = cameras.unproject(pixel, intrinsics) @ world_from_camera[:3, :3].T
    hits = caster.cast(world_from_camera[:3, 3], direction)
    distance = np.where(hits.face >= 0, hits.distance, np.nan)
    return world_from_camera[:3, 3] + direction * distance[:, None]
