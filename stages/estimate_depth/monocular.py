"""Align monocular depth to meters: per-frame scale and shift from the map's depth."""

import numpy as np
from jaxtyping import Bool, Float

ROUNDS = 8
"""Iterations of reweighted least squares; the weights converge earlier."""
MIN_PIXELS = 50
"""Least map pixels for alignment."""
NEAREST_M, FARTHEST_M = 0.1, 20.0
"""Range of valid depth, meters."""


def aligned(
    inverse: Float[np.ndarray, "height width"],
    mapped: Float[np.ndarray, "height width"],
    counts: Bool[np.ndarray, "height width"],
) -> Float[np.ndarray, "height width"]:
    """Return metric depth from relative inverse depth: 1 / depth = scale * inverse + shift.

    Scale and shift are fitted to the map's depth (meters) where ``counts``, with Cauchy weights scaled by the
    median residual. Returns 0 where depth is invalid, and everywhere if too little counts or scale <= 0.
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
