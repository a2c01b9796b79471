"""Single frames of real sessions placed on the map without odometry: our localizer and a simple baseline.

It shows that the built-in world is not easy: SIFT points of the walk-through with PnP (color only).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float

from pipeline.data.clips import Clip
from pipeline.geometry import rigid
from pipeline.localization.localizer import Localizer
from pipeline.mapping import sift
from pipeline.metrics.metrics import Metrics, mean, median
from pipeline.metrics.pose_errors import PoseErrors

WITHIN_DEG, WITHIN_M = 5, 0.2
"""Error bounds in the metric's name."""
REPROJECTION_PX, PNP_ITERATIONS = 4.0, 2000
FAILED = "more than half of the frames were not placed"


@dataclass(frozen=True)
class SiftMap:
    """SIFT descriptors of the walk-through and their 3-D points."""

    descriptors: Float[np.ndarray, "point 128"]
    points_world: Float[np.ndarray, "point 3"]


def metrics_of(name: str, errors: PoseErrors) -> Metrics:
    """Summarize errors of single frames; frames without a pose count as failures."""
    metrics = Metrics()
    metrics.put(f"{name}rotation_deg_median", median(errors.degrees), FAILED)
    metrics.put(f"{name}translation_m_median", median(errors.meters), FAILED)
    within = (errors.degrees <= WITHIN_DEG) & (errors.meters <= WITHIN_M)
    metrics.put(f"{name}within_5deg_20cm_share", mean(within))
    return metrics


def placed_by_localizer(
    localizer: Localizer, clip: Clip, frames: Sequence[int], hide: Sequence[Bool[np.ndarray, "height width"]]
) -> tuple[Float[np.ndarray, "frame 4 4"], Float[np.ndarray, "frame"]]:
    """Return ``world_from_camera [frame 4 4]``, NaN where not placed, and the probability of each (0 where
    not placed); ``hide`` marks the agent's pixels.
    """
    found, probability = [], []
    for frame, hidden in zip(frames, hide, strict=True):
        camera = (clip.depth_intrinsics[frame], clip.intrinsics[frame])
        answers = localizer.localize(clip.color(frame), clip.depth(frame), *camera, ~hidden)
        found.append(answers[0].map_from_camera if answers else np.full((4, 4), np.nan))
        probability.append(answers[0].probability if answers else 0.0)
    return np.array(found).reshape(-1, 4, 4), np.array(probability)


def sift_map(clip: Clip, world_from_camera: Float[np.ndarray, "frame 4 4"], frames: Sequence[int]) -> SiftMap:
    """Lift the SIFT points of walk-through frames by their depth."""
    descriptors, points = [], []
    for frame in frames:
        lenses = clip.intrinsics[frame], clip.depth(frame), clip.depth_intrinsics[frame]
        lifted = sift.lift(_sift(clip.color(frame)), *lenses)
        points.append(rigid.apply(world_from_camera[frame], lifted.points_camera))
        descriptors.append(lifted.descriptors)
    return SiftMap(np.concatenate(descriptors), np.concatenate(points))


def placed_by_sift(known: SiftMap, clip: Clip, frames: Sequence[int]) -> Float[np.ndarray, "frame 4 4"]:
    """Match each frame's SIFT points to the map and solve PnP with RANSAC; NaN where that fails."""
    matcher, found = cv2.BFMatcher(cv2.NORM_L2), []
    for frame in frames:
        keypoints = _sift(clip.color(frame))
        found.append(np.full((4, 4), np.nan))
        if len(keypoints.pixel) < 8:
            continue
        nearest = matcher.match(keypoints.descriptors, known.descriptors)
        points = known.points_world[[match.trainIdx for match in nearest]]
        cv2.setRNGSeed(0)
        ok, turn, shift, inliers = cv2.solvePnPRansac(
            points,
            keypoints.pixel,
            clip.intrinsics[frame],
            None,
            iterationsCount=PNP_ITERATIONS,
            reprojectionError=REPROJECTION_PX,
        )
        if ok and inliers is not None and len(inliers) >= 8:
            found[-1] = rigid.inverse(rigid.make(rigid.rotation_from_vector(turn[:, 0]), shift[:, 0]))
    return np.array(found).reshape(-1, 4, 4)


def _sift(color: np.ndarray) -> sift.Keypoints:
    return sift.describe(cv2.cvtColor(color, cv2.COLOR_RGB2GRAY))
