"""SIFT points with a place in space: described in the picture, lifted by the depth under them, matched between frames."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from pipeline.space import cameras

RATIO = 0.8
"""a match counts when the second best is this much worse (Lowe 2004)"""


@dataclass(frozen=True)
class SiftPoints:
    """Points of one frame that have depth."""

    descriptors: Float[np.ndarray, "point 128"]
    """Rooted (Arandjelovic and Zisserman 2012)."""
    points_camera: Float[np.ndarray, "point 3"]


def sift_points(
    gray: UInt8[np.ndarray, "height width"],
    intrinsics: Float[np.ndarray, "3 3"],
    depth: Float[np.ndarray, "depth_height depth_width"],
    depth_intrinsics: Float[np.ndarray, "3 3"],
    most: int,
) -> SiftPoints:
    """Describe the ``most`` strongest points of a picture and keep those under which depth is known."""
    keypoints, descriptors = cv2.SIFT.create(most).detectAndCompute(gray, None)
    if not keypoints:
        return SiftPoints(np.zeros((0, 128), np.float32), np.zeros((0, 3)))
    ray = cameras.unproject(np.array([point.pt for point in keypoints]) + 0.5, intrinsics)
    pixel, _ = cameras.project(ray, depth_intrinsics)
    column, row = np.clip(np.floor(pixel).astype(int), 0, np.array(depth.shape[::-1]) - 1).T
    z = depth[row, column]
    rooted = np.sqrt(descriptors / np.maximum(descriptors.sum(1, keepdims=True), 1e-6))
    return SiftPoints(rooted[z > 0], (ray * z[:, None])[z > 0])


def matches(first: SiftPoints, second: SiftPoints) -> Int[np.ndarray, "match 2"]:
    """Return the pairs (in the first, in the second) that look alike, and like no other."""
    if len(second.descriptors) < 2:
        return np.zeros((0, 2), int)
    pairs = cv2.BFMatcher(cv2.NORM_L2).knnMatch(first.descriptors, second.descriptors, k=2)
    return np.array([(a.queryIdx, a.trainIdx) for a, b in pairs if a.distance < RATIO * b.distance], int).reshape(-1, 2)
