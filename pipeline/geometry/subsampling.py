"""Even subsampling of frames and other sequences, and the runs and short gaps in them."""

import itertools

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped


def evenly(count: int, most: int, *, rounded: bool = False) -> Int[np.ndarray, "chosen"]:
    """Return at most ``most`` indices of ``count`` items, first and last included, evenly spaced and sorted.

    ``rounded`` takes the nearest index instead of the one below. Empty for ``count`` 0.
    """
    places = np.linspace(0, max(count - 1, 0), min(most, count))
    return np.unique((np.round(places) if rounded else places).astype(int))


def some(items: Shaped[np.ndarray, "item *rest"], most: int) -> Shaped[np.ndarray, "chosen *rest"]:
    """Return at most ``most`` of the items, evenly spaced, first and last included."""
    return items[evenly(len(items), most)]


def nearest(
    times: Float[np.ndarray, "frame"], wanted: Float[np.ndarray, "sample"]
) -> Int[np.ndarray, "sample"]:
    """Return the index of the nearest of increasing times."""
    return np.searchsorted((times[1:] + times[:-1]) / 2, wanted)


def sharpest_of_steps(
    step: Int[np.ndarray, "frame"], sharpness: Float[np.ndarray, "frame"]
) -> Int[np.ndarray, "chosen"]:
    """Return the sharpest frame of every step; steps are numbered in order of time."""
    starts = np.flatnonzero(np.diff(step, prepend=-1) > 0)
    bounds = np.append(starts, len(step))
    return np.array([low + int(sharpness[low:high].argmax()) for low, high in itertools.pairwise(bounds)])


def farthest_points(
    points: Float[np.ndarray, "point axis"], count: int, first: int
) -> Int[np.ndarray, "chosen"]:
    """Choose up to ``count`` points by farthest-point sampling, beginning with the index ``first``."""
    chosen, distance = [first], np.full(len(points), np.inf)
    while len(chosen) < min(count, len(points)):
        distance = np.minimum(distance, ((points - points[chosen[-1]]) ** 2).sum(1))
        chosen.append(int(distance.argmax()))
    return np.sort(np.array(chosen))


def runs(good: Bool[np.ndarray, "frame"]) -> Int[np.ndarray, "run 2"]:
    """Return start and end (exclusive) of each run of consecutive true values."""
    return np.flatnonzero(np.diff(np.pad(good, 1).astype(np.int8))).reshape(-1, 2)


def within_short_gaps(
    good: Float[np.ndarray, "frame"], grid: Float[np.ndarray, "sample"], max_gap_s: float, near_s: float = 0.0
) -> Bool[np.ndarray, "sample"]:
    """Return which grid times are within ``near_s`` of a good time, or in a gap of at most ``max_gap_s``."""
    after = np.searchsorted(good, grid, side="left").clip(0, len(good) - 1)
    before = (np.searchsorted(good, grid, side="right") - 1).clip(0)
    on_frame = np.minimum(np.abs(good[after] - grid), np.abs(good[before] - grid)) <= near_s
    between = (good[before] <= grid) & (grid <= good[after]) & (good[after] - good[before] <= max_gap_s)
    return on_frame | between
