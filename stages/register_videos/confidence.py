"""Confidence of each pose: its covariance, and whether its picture looks like the place.

A wrong pose can have a small covariance, since rooms have floors and walls everywhere; but then its picture
resembles its rendering no more than renderings from poses that are wrong on purpose (targets and decoys,
Elias and Gygi 2007).
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int

from pipeline.data.clips import Clip, Masks
from pipeline.geometry import rigid, subsampling
from pipeline.geometry.meshes import RayCaster
from stages.register_videos.agent_roots import Roots
from stages.register_videos.agent_tracking import excess
from stages.register_videos.comparison import ncc
from stages.register_videos.config import ConfidenceConfig

NEAR_RAD, NEAR_M = np.deg2rad(2.0), 0.05
"""Within which a camera's pose counts as right."""
DECOY_SIZE = (1.5, 10.0)
"""Decoys are wrong by between these multiples of `NEAR_RAD` or `NEAR_M`."""
ATTEMPTS = 3
"""A frame is held against the best of so many decoys, since alignment took the best pose in reach."""
AVERAGING_S = 1.0
"""Time constant over which scores are averaged, seconds: neighbouring poses err together."""
UNANCHORED = 0.2
"""Factor on frames that neither a vote nor unbroken odometry from one holds."""
MIN_SCORED = 20
"""Short recordings are compared in at least so many frames."""
DRAWS = 400
"""Monte Carlo samples of a pose's covariance."""
COST_SCALE_M, ENOUGH_SHARE = 0.012, 0.15
"""Roots: excess of cost that halves the confidence or so (metres), and visible share from which on visibility
no longer counts."""


@dataclass(frozen=True)
class NccScores:
    """Normalized cross-correlation of frames with renderings, from their poses and wrong ones; NaN: none."""

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
    """Score frames against renderings from their poses and from poses that are wrong on purpose (decoys)."""
    chosen = subsampling.evenly(len(clip), max(len(clip) // config.every_frames, MIN_SCORED))
    wrong = rng.integers(0, len(clip), config.decoys)
    decoys = world_from_camera[wrong] @ rigid.exp(_wrong_twists(config.decoys, rng))

    def scored(frames, poses) -> Float[np.ndarray, "_"]:
        pairs = zip(frames.tolist(), poses, strict=True)
        return np.array([ncc(clip, masks, caster, frame, pose) for frame, pose in pairs])

    return NccScores(chosen, scored(chosen, world_from_camera[chosen]), scored(wrong, decoys))


def _wrong_twists(count, rng):
    """Draw motions whose turn or step, or both, is the drawn multiple of what counts as near."""
    low, high = np.log(DECOY_SIZE)
    size = np.exp(rng.uniform(low, high, count))[:, None]
    part = rng.uniform(0, 1, (count, 2))
    part /= part.max(1, keepdims=True)
    turn, step = (
        each / np.linalg.norm(each, axis=1, keepdims=True) for each in rng.normal(size=(2, count, 3))
    )
    return np.concatenate([turn * part[:, :1] * size * NEAR_RAD, step * part[:, 1:] * size * NEAR_M], axis=1)


def appearance_probability(
    timestamp_s: Float[np.ndarray, "frame"], scores: NccScores
) -> Float[np.ndarray, "frame"]:
    """Return the probability that each frame shows the place of its pose, by the pictures around it."""
    known = np.isfinite(scores.targets)
    targets = averaged(timestamp_s, timestamp_s[scores.frame[known]], scores.targets[known], AVERAGING_S)
    return right_place(targets, scores.decoys, ATTEMPTS)


def camera_confidence(
    pose_covariance: Float[np.ndarray, "frame 6 6"],
    appearance: Float[np.ndarray, "frame"],
    anchored: Bool[np.ndarray, "frame"],
    rng: np.random.Generator,
) -> Float[np.ndarray, "frame"]:
    """Return P(camera within 2 deg and 5 cm): by its covariance, times P(right place) by appearance."""
    return near_probability(pose_covariance, rng) * appearance * np.where(anchored, 1.0, UNANCHORED)


def right_place(
    targets: Float[np.ndarray, "frame"], decoys: Float[np.ndarray, "decoy"], attempts: int
) -> Float[np.ndarray, "frame"]:
    """Return one minus the q-value: the least share of decoys over the share of targets that look at least so
    much alike, of all limits that a frame passes; 0 where nothing can be compared."""
    decoys, known = decoys[np.isfinite(decoys)], np.flatnonzero(np.isfinite(targets))
    order = known[np.argsort(targets[known], kind="stable")]
    limit, found = targets[order], np.zeros(len(targets))
    passing = (0.5 + len(decoys) - np.searchsorted(np.sort(decoys), limit)) / (1 + len(decoys))
    wrong = (1 - (1 - passing) ** attempts) / (
        (len(order) - np.searchsorted(limit, limit)) / max(len(targets), 1)
    )
    found[order] = np.maximum.accumulate(np.maximum(1 - wrong, 0.0))
    return found


def near_probability(
    pose_covariance: Float[np.ndarray, "frame 6 6"], rng: np.random.Generator, draws: int = DRAWS
) -> Float[np.ndarray, "frame"]:
    """Return how likely a twist of zero mean and this covariance stays within 2 deg and 5 cm."""
    normal, found = rng.normal(size=(6, draws)), np.empty(len(pose_covariance))
    variance, axes = np.linalg.eigh(pose_covariance)
    for frame, root in enumerate(axes * np.sqrt(np.maximum(variance, 0))[:, None, :]):
        drawn = root @ normal
        found[frame] = (
            (np.linalg.norm(drawn[:3], axis=0) < NEAR_RAD) & (np.linalg.norm(drawn[3:], axis=0) < NEAR_M)
        ).mean()
    return found


def averaged(
    timestamp_s: Float[np.ndarray, "frame"],
    known_s: Float[np.ndarray, "known"],
    values: Float[np.ndarray, "known"],
    sigma_s: float,
) -> Float[np.ndarray, "frame"]:
    """Average values known at some times with Gaussian weights, cut at four sigma; NaN beyond."""
    low = np.searchsorted(known_s, timestamp_s - 4 * sigma_s)
    high = np.searchsorted(known_s, timestamp_s + 4 * sigma_s, side="right")
    result = np.full(len(timestamp_s), np.nan)
    for frame, (first, last) in enumerate(zip(low, high, strict=True)):
        if last > first:
            weight = np.exp(-0.5 * ((known_s[first:last] - timestamp_s[frame]) / sigma_s) ** 2)
            result[frame] = weight @ values[first:last] / weight.sum()
    return result


def agent_confidence(roots: Roots) -> Float[np.ndarray, "frame"]:
    """Score each root 0..1: full for the video's usual fit in good view, less where it fits worse or little
    is seen; 0 unseen."""
    worse = excess(roots.cost_m) / COST_SCALE_M
    return np.where(roots.visible, np.exp(-0.5 * worse**2) * np.minimum(roots.share / ENOUGH_SHARE, 1.0), 0.0)
