"""Intervals for means over overlapping windows: whole episodes are drawn again, not single windows."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int


@dataclass(frozen=True)
class Interval:
    """A mean and its 95 % interval."""

    mean: float
    low: float
    high: float


def episodes(start: Int[np.ndarray, "window"], video: Int[np.ndarray, "window"], frames: int) -> Int[np.ndarray, "window"]:
    """Number stretches of ``frames`` frames, so that windows of different episodes hardly overlap."""
    return np.unique(np.stack([video, start // frames], axis=1), axis=0, return_inverse=True)[1].ravel()


def bootstrapped(values: Float[np.ndarray, "window"], episode: Int[np.ndarray, "window"], draws: int, rng: np.random.Generator) -> Interval:
    """Resample episodes with replacement and return the mean with its percentiles 2.5 and 97.5."""
    count = episode.max() + 1
    total = np.bincount(episode, values, count)
    size = np.bincount(episode, minlength=count)
    chosen = rng.integers(0, count, (draws, count))
    means = total[chosen].sum(1) / size[chosen].sum(1)
    return Interval(float(values.mean()), *(float(bound) for bound in np.percentile(means, (2.5, 97.5))))
