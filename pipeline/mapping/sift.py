"""SIFT keypoints: detection, back-projection by depth, and matching."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from pipeline.geometry import cameras

RATIO = 0.8
"""Largest distance ratio of the best to the second-best match (Lowe 2004)."""
MIN_NORM = 1e-6
PEAK_THRESHOLD = 0.04
"""OpenCV's contrast threshold."""


@dataclass(frozen=True)
class Keypoints:
    """Keypoints of one picture."""

    pixel: Float[np.ndarray, "point 2"]
    """centers at +0.5"""
    descriptors: Float[np.ndarray, "point 128"]
    """RootSIFT (Arandjelovic and Zisserman 2012)."""


@dataclass(frozen=True)
class SiftPoints:
    """Keypoints of one frame with depth, camera frame, meters."""

    descriptors: Float[np.ndarray, "point 128"]
    points_camera: Float[np.ndarray, "point 3"]


def describe(
    gray: UInt8[np.ndarray, "height width"],
    max_points: int = 0,
    peak_threshold: float = PEAK_THRESHOLD,
    usable: UInt8[np.ndarray, "height width"] | None = None,
) -> Keypoints:
    """Describe the ``max_points`` strongest keypoints (0: all) of the ``usable`` pixels."""
    # Without precise upscaling OpenCV's points are off by a quarter of a pixel to the lower right.
    sift = cv2.SIFT.create(max_points, contrastThreshold=peak_threshold, enable_precise_upscale=True)
    keypoints, descriptors = sift.detectAndCompute(gray, usable)
    if not keypoints:
        return Keypoints(np.zeros((0, 2)), np.zeros((0, 128), np.float32))
    root_sift = np.sqrt(descriptors / np.maximum(descriptors.sum(1, keepdims=True), MIN_NORM))
    return Keypoints(np.array([point.pt for point in keypoints]) + 0.5, root_sift.astype(np.float32))


def lift(
    keypoints: Keypoints,
    intrinsics: Float[np.ndarray, "3 3"],
    depth: Float[np.ndarray, "depth_height depth_width"],
    depth_intrinsics: Float[np.ndarray, "3 3"],
) -> SiftPoints:
    """Back-project the keypoints that have depth (meters) to the camera frame."""
    points = cameras.back_project_pixels(keypoints.pixel, intrinsics, depth, depth_intrinsics)
    known = points[:, 2] > 0
    return SiftPoints(keypoints.descriptors[known], points[known])


def matches(
    first: Float[np.ndarray, "first 128"], second: Float[np.ndarray, "second 128"]
) -> Int[np.ndarray, "match 2"]:
    """Return index pairs (first, second) that pass the ratio test."""
    if not len(first) or len(second) < 2:
        return np.zeros((0, 2), int)
    pairs = cv2.BFMatcher(cv2.NORM_L2).knnMatch(first, second, k=2)
    return np.array(
        [(a.queryIdx, a.trainIdx) for a, b in pairs if a.distance < RATIO * b.distance], int
    ).reshape(-1, 2)
