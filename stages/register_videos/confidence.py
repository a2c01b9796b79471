"""Confidence of each pose: its covariance, and whether its picture matches the rendering.

A wrong pose can have a small covariance, since floors and walls are everywhere; but then its picture
correlates with its rendering no better than with renderings from deliberately wrong poses (target-decoy
approach, Elias and Gygi 2007).
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from pipeline.data.clips import Clip, Masks
from pipeline.geometry import rigid, subsampling
from pipeline.geometry.meshes import RayCaster
from stages.register_videos.agent_roots import Roots
from stages.register_videos.agent_tracking import excess_cost
from stages.register_videos.comparison import ncc
from stages.register_videos.config import ConfidenceConfig

TOL_RAD, TOL_M = np.deg2rad(2.0), 0.05
"""Largest error of a correct camera pose, radians and meters."""
DECOY_RANGE = (1.5, 10.0)
"""Range of the decoys' errors, in multiples of `TOL_RAD` and `TOL_M`."""
ATTEMPTS = 3
"""Decoys per frame whose best score counts, since alignment also chose the best pose in reach."""
AVERAGING_S = 1.0
"""Standard deviation of the Gaussian that averages scores, seconds: neighboring errors are correlated."""
UNANCHORED_FACTOR = 0.2
"""Factor on the confidence of frames without a vote in their odometry segment."""
MIN_SCORED = 20
"""Least number of scored frames, for short recordings."""
DRAWS = 400
"""Monte Carlo samples of a pose's covariance."""
COST_SCALE, ENOUGH_SHARE = 0.02, 0.15
"""Roots: standard deviation of the excess cost (body lengths), and visible share of full confidence."""


@dataclass(frozen=True)
class NccScores:
    """Normalized cross-correlation of frames with renderings from their poses and from decoys; may be NaN."""

    frame: Int[np.ndarray, "compared"]
    targets: Float[np.ndarray, "compared"]
    decoys: Float[np.ndarray, "decoy"]


def score_appearance(
    clip: Clip,
    masks: Masks,
    caster: RayCaster,
    world_from_camera: Float[np.ndarray, "frame 4 4"],
    config: ConfidenceConfig,
    rng: np.random.Generator,
) -> NccScores:
    """Score frames against renderings from their poses and from deliberately wrong poses (decoys)."""
    chosen = subsampling.evenly(len(clip), max(len(clip) // config.every_frames, MIN_SCORED))
    wrong = rng.integers(0, len(clip), config.decoys)
    decoys = world_from_camera[wrong] @ rigid.exp(_decoy_twists(config.decoys, rng))

    def score(frames, poses) -> Float[np.ndarray, "_"]:
        pairs = zip(frames.tolist(), poses, strict=True)
        return np.array([ncc(clip, masks, caster, frame, pose) for frame, pose in pairs])

    return NccScores(chosen, score(chosen, world_from_camera[chosen]), score(wrong, decoys))


def _decoy_twists(count, rng):
    """Draw twists whose larger part, rotation or translation, is a random multiple of the tolerance."""
    low, high = np.log(DECOY_RANGE)
    size = np.exp(rng.uniform(low, high, count))[:, None]
    ratio = rng.uniform(0, 1, (count, 2))
    ratio /= ratio.max(1, keepdims=True)
    turn, step = (
        each / np.linalg.norm(each, axis=1, keepdims=True) for each in rng.normal(size=(2, count, 3))
    )
    return np.concatenate([turn * ratio[:, :1] * size * TOL_RAD, step * ratio[:, 1:] * size * TOL_M], axis=1)


def appearance_probability(
    timestamp_s: Float[np.ndarray, "frame"], scores: NccScores
) -> Float[np.ndarray, "frame"]:
    """Return the probability that each frame shows the place of its pose, from the scores around it."""
    known = np.isfinite(scores.targets)
    targets = kernel_mean(timestamp_s, timestamp_s[scores.frame[known]], scores.targets[known], AVERAGING_S)
    return place_probability(targets, scores.decoys, ATTEMPTS)


def camera_confidence(
    pose_covariance: Float[np.ndarray, "frame 6 6"],
    appearance: Float[np.ndarray, "frame"],
    anchored: Bool[np.ndarray, "frame"],
    rng: np.random.Generator,
) -> Float[np.ndarray, "frame"]:
    """Return P(camera within 2 deg and 5 cm): by its covariance, times P(right place) by appearance."""
    return within_tolerance(pose_covariance, rng) * appearance * np.where(anchored, 1.0, UNANCHORED_FACTOR)


def place_probability(
    targets: Float[np.ndarray, "frame"], decoys: Float[np.ndarray, "decoy"], attempts: int
) -> Float[np.ndarray, "frame"]:
    """Return one minus each frame's q-value, the least false discovery rate at which it passes.

    The rate at a threshold is the share of decoys over the share of targets above it; 0 without a score.
    """
    decoys, known = decoys[np.isfinite(decoys)], np.flatnonzero(np.isfinite(targets))
    order = known[np.argsort(targets[known], kind="stable")]
    limit, found = targets[order], np.zeros(len(targets))
    passing = (0.5 + len(decoys) - np.searchsorted(np.sort(decoys), limit)) / (1 + len(decoys))
    wrong = (1 - (1 - passing) ** attempts) / (
        (len(order) - np.searchsorted(limit, limit)) / max(len(targets), 1)
    )
    found[order] = np.maximum.accumulate(np.maximum(1 - wrong, 0.0))
    return found


def within_tolerance(
    pose_covariance: Float[np.ndarray, "frame 6 6"], rng: np.random.Generator, draws: int = DRAWS
) -> Float[np.ndarray, "frame"]:
    """Return the probability that a zero-mean twist of this covariance is within 2 deg and 5 cm."""
    normal, found = rng.normal(size=(6, draws)), np.empty(len(pose_covariance))
    variance, axes = np.linalg.eigh(pose_covariance)
    for frame, root in enumerate(axes * np.sqrt(np.maximum(variance, 0))[:, None, :]):
        drawn = root @ normal
        found[frame] = (
            (np.linalg.norm(drawn[:3], axis=0) < TOL_RAD) & (np.linalg.norm(drawn[3:], axis=0) < TOL_M)
        ).mean()
    return found


def kernel_mean(
    timestamp_s: Float[np.ndarray, "frame"],
    known_s: Float[np.ndarray, "known"],
    values: Float[np.ndarray, "known"],
    sigma_s: float,
) -> Float[np.ndarray, "frame"]:
    """Average known values with Gaussian weights in time, truncated at four sigma; NaN beyond."""
    low = np.searchsorted(known_s, timestamp_s - 4 * sigma_s)
    high = np.searchsorted(known_s, timestamp_s + 4 * sigma_s, side="right")
    result = np.full(len(timestamp_s), np.nan)
    for frame, (first, last) in enumerate(zip(low, high, strict=True)):
        if last > first:
            weight = np.exp(-0.5 * ((known_s[first:last] - timestamp_s[frame]) / sigma_s) ** 2)
            result[frame] = weight @ values[first:last] / weight.sum()
    return result


def agent_confidence(roots: Roots) -> Float[np.ndarray, "frame"]:
    """Score each root 0..1 by excess cost, visible share and probability of the heading; 0 where unseen."""
    worse = excess_cost(roots.cost) / COST_SCALE
    fitted = np.exp(-0.5 * worse**2) * np.minimum(roots.share / ENOUGH_SHARE, 1.0)
    return np.where(roots.visible, fitted * roots.facing, 0.0)
