"""Even subsampling of frames and of other sequences: one rule for the whole project."""

import numpy as np
from jaxtyping import Int


def evenly(count: int, most: int, *, rounded: bool = False) -> Int[np.ndarray, "chosen"]:
    """Return at most ``most`` indices of ``count`` items, first and last included, evenly spaced and sorted.

    ``rounded`` takes the nearest index instead of the one below. None of nothing.
    """
    places = np.linspace(0, max(count - 1, 0), min(most, count))
    return np.unique((np.round(places) if rounded else places).astype(int))
