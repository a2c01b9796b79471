"""Check that a video without depth can be mapped: neighboring pictures overlap with parallax."""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from pipeline.mapping import sift
from pipeline.mapping.sift import Keypoints
from stages.check_captures.sampling import SampledFrame

SIDE_PX, POINTS, WITHIN_PX = 480, 800, 2.0
MIN_INLIERS = 25
"""minimum inliers of two overlapping views"""
CONFIDENCE = 0.999
"""confidence of RANSAC"""
MAX_ROTATION_SHARE = 0.9
"""share of inliers explained by a rotation (or one plane) beyond which there is no parallax"""


@dataclass(frozen=True)
class Parallax:
    """Overlap and parallax of pairs of neighboring sampled pictures, shares 0..1."""

    linked: float
    """overlapping pairs"""
    with_parallax: float
    """pairs with parallax among these"""


def parallax(shots: Sequence[SampledFrame]) -> Parallax:
    """Match neighboring pictures and compare epipolar geometry with a rotation."""
    described = [_described(shot) for shot in shots]
    links = [link for pair in itertools.pairwise(described) if (link := _link(*pair)) is not None]
    with_parallax = float(np.mean([turned < MAX_ROTATION_SHARE for turned in links])) if links else 0.0
    return Parallax(len(links) / max(len(shots) - 1, 1), with_parallax)


def _described(shot: SampledFrame) -> Keypoints:
    scale = min(1.0, SIDE_PX / max(shot.gray.shape))
    small = cv2.resize(shot.gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return sift.describe(small, POINTS)


def _link(first: Keypoints, second: Keypoints) -> float | None:
    """Return the share of a pair's inliers that a rotation explains; None with too few."""
    pairs = sift.matches(first.descriptors, second.descriptors)
    if len(pairs) < MIN_INLIERS:
        return None
    mine, theirs = first.pixel[pairs[:, 0]], second.pixel[pairs[:, 1]]
    _, two_views = cv2.findFundamentalMat(mine, theirs, cv2.FM_RANSAC, WITHIN_PX, CONFIDENCE)
    _, turn = cv2.findHomography(mine, theirs, cv2.RANSAC, WITHIN_PX)
    if two_views is None or turn is None or two_views.sum() < MIN_INLIERS:
        return None
    return float(turn.sum() / two_views.sum())
