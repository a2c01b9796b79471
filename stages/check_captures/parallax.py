"""Whether a video without depth can be mapped: do neighbours show the same things, from elsewhere."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from stages.check_captures.sampling import SampledFrame

SIDE_PX, POINTS, RATIO, WITHIN_PX = 480, 800, 0.8, 2.0
LINKED = 25
"""matches on which two views must agree to show the same things"""
CONFIDENCE = 0.999
"""of RANSAC, that it has found the geometry of two views"""
TURNED = 0.9
"""share of these explained by a mere turn of the camera (or one plane) beyond which there is no parallax"""


@dataclass(frozen=True)
class Parallax:
    """What pairs of neighbouring sample pictures have in common, shares 0..1."""

    linked: float
    """pairs that show the same things"""
    with_parallax: float
    """of these, pairs in which things shift against each other"""


def parallax(shots: Sequence[SampledFrame]) -> Parallax:
    """Match neighbouring pictures and compare two views of a scene with a mere turn."""
    described = [_described(shot) for shot in shots]
    links = [link for pair in itertools.pairwise(described) if (link := _link(*pair)) is not None]
    with_parallax = float(np.mean([turned < TURNED for turned in links])) if links else 0.0
    return Parallax(len(links) / max(len(shots) - 1, 1), with_parallax)


def _described(shot: SampledFrame) -> tuple[np.ndarray, np.ndarray | None]:
    scale = min(1.0, SIDE_PX / max(shot.gray.shape))
    small = cv2.resize(shot.gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    keypoints, descriptors = cv2.SIFT.create(POINTS).detectAndCompute(small, None)
    return np.array([point.pt for point in keypoints], np.float32).reshape(-1, 2), descriptors


def _link(
    first: tuple[np.ndarray, np.ndarray | None], second: tuple[np.ndarray, np.ndarray | None]
) -> float | None:
    """Return the share of a pair's matches that a turn explains; None where the pair has too few."""
    mine, theirs = first[1], second[1]
    if mine is None or theirs is None or min(len(mine), len(theirs)) < LINKED:
        return None
    pairs = cv2.BFMatcher(cv2.NORM_L2).knnMatch(mine, theirs, k=2)
    good = np.array([(a.queryIdx, a.trainIdx) for a, b in pairs if a.distance < RATIO * b.distance], int)
    if len(good) < LINKED:
        return None
    mine, theirs = first[0][good[:, 0]], second[0][good[:, 1]]
    _, two_views = cv2.findFundamentalMat(mine, theirs, cv2.FM_RANSAC, WITHIN_PX, CONFIDENCE)
    _, turn = cv2.findHomography(mine, theirs, cv2.RANSAC, WITHIN_PX)
    if two_views is None or turn is None or two_views.sum() < LINKED:
        return None
    return float(turn.sum() / two_views.sum())
