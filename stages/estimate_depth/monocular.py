"""Metres for a network's depth: the map's depth around the animal gives scale and shift, frame by frame."""

import numpy as np
from jaxtyping import Bool, Float

ROUNDS = 8
"""Reweighted least-squares fits; the weights have settled by then."""
MIN_PIXELS = 50
"""Pixels of the map without which a frame cannot be scaled."""
NEAREST_M, FARTHEST_M = 0.1, 20.0
"""Depth beyond these is none, metres."""


def aligned(
    inverse: Float[np.ndarray, "height width"],
    mapped: Float[np.ndarray, "height width"],
    counts: Bool[np.ndarray, "height width"],
) -> Float[np.ndarray, "height width"]:
    """Return depth in metres from numbers that grow with inverse depth: 1 / depth = scale * number + shift.

    Scale and shift are fitted to the map's depth (metres) where it ``counts``, Cauchy weights at the median
    residual; 0 where there is none, and everywhere where too little counts or the scale is not positive.
    """
    if counts.sum() < MIN_PIXELS:
        return np.zeros(inverse.shape, np.float32)
    known, target = inverse[counts].astype(float), 1 / mapped[counts].astype(float)
    design, weight = np.stack([known, np.ones_like(known)], axis=1), np.ones(len(known))
    for _ in range(ROUNDS):
        root = np.sqrt(weight)[:, None]
        (scale, shift), *_ = np.linalg.lstsq(root * design, root[:, 0] * target, rcond=None)
        residual = np.abs(scale * known + shift - target)
        weight = 1 / (1 + (residual / max(float(np.median(residual)), 1e-6)) ** 2)
    if scale <= 0:
        return np.zeros(inverse.shape, np.float32)
    fitted = np.clip(scale * inverse + shift, 1 / FARTHEST_M, 1 / NEAREST_M)
    inside = (fitted > 1 / FARTHEST_M) & (fitted < 1 / NEAREST_M)
    return np.where(inside, 1 / fitted, 0).astype(np.float32)
