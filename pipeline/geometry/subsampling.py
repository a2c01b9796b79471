"""Even subsampling of frames and other sequences, and tests for short gaps in them."""

import numpy as np
from jaxtyping import Bool, Float, Int


def evenly(count: int, most: int, *, rounded: bool = False) -> Int[np.ndarray, "chosen"]:
    """Return at most ``most`` indices of ``count`` items, first and last included, evenly spaced and sorted.

    ``rounded`` takes the nearest index instead of the one below. Empty for ``count`` 0.
    """
    places = np.linspace(0, max(count - 1, 0), min(most, count))
    return np.unique((np.round(places) if rounded else places).astype(int))


def within_short_gaps(
    good: Float[np.ndarray, "frame"], grid: Float[np.ndarray, "sample"], max_gap_s: float, near_s: float = 0.0
) -> Bool[np.ndarray, "sample"]:
    """Return which grid times are within ``near_s`` of a good time, or in a gap of at most ``max_gap_s``."""
    after = np.searchsorted(good, grid, side="left").clip(0, len(good) - 1)
    before = (np.searchsorted(good, grid, side="right") - 1).clip(0)
    on_frame = np.minimum(np.abs(good[after] - grid), np.abs(good[before] - grid)) <= near_s
    between = (good[before] <= grid) & (grid <= good[after]) & (good[after] - good[before] <= max_gap_s)
    return on_frame | between
