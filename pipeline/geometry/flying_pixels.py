"""Distinguish thin objects from flying pixels in depth images, where the sensor is unsure of both."""

import numpy as np
from jaxtyping import Bool, Float

SUPPORTERS, TOLERANCE_M = 3, 0.03
"""neighbors within this tolerance of depth on a surface; a flying pixel along a straight edge has two"""


def supported(depth: Float[np.ndarray, "height width"]) -> Bool[np.ndarray, "height width"]:
    """Return which pixels have three of eight neighbors at nearly their own depth (meters, 0 = unknown)."""
    height, width = depth.shape
    around = np.pad(depth, 1)
    count = np.zeros(depth.shape, np.uint8)
    for row, column in np.ndindex(3, 3):
        neighbor = around[row : row + height, column : column + width]
        count += (np.abs(neighbor - depth) < TOLERANCE_M) & (neighbor > 0)
    return (depth > 0) & (count > SUPPORTERS)
