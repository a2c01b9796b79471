"""Whether depth is aligned with the picture: pictures have edges where nearer surfaces end."""

import cv2
import numpy as np
from jaxtyping import Float, UInt8

STEP_SHARE, STEP_M = 0.08, 0.05
"""a depth step: farther by this share of the depth plus this many meters"""
BLUR_PX, NEIGHBORHOOD_PX, MIN_GRADIENT = 1.0, 31, 5.0
"""blur before gradients, neighborhood of the local mean gradient, and floor of it (0..255 per pixel)"""
MIN_PIXELS = 100
"""minimum pixels at depth steps"""


def relative_slopes(gray: UInt8[np.ndarray, "height width"]) -> Float[np.ndarray, "height width 2"]:
    """Return derivatives by x and y relative to the local mean gradient, which light and texture change."""
    smooth = cv2.GaussianBlur(gray.astype(np.float32), (0, 0), BLUR_PX)
    x, y = cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1)
    mean = cv2.blur(np.hypot(x, y), (NEIGHBORHOOD_PX, NEIGHBORHOOD_PX)) + np.float32(MIN_GRADIENT)
    return np.stack([x / mean, y / mean], axis=-1)


def relative_gradient(gray: UInt8[np.ndarray, "height width"]) -> Float[np.ndarray, "height width"]:
    """Return the length of `relative_slopes`."""
    slopes = relative_slopes(gray)
    return np.hypot(slopes[..., 0], slopes[..., 1])


def edge_contrast(
    gradient: Float[np.ndarray, "height width"], depth: Float[np.ndarray, "height width"]
) -> float:
    """Return how much stronger `relative_gradient` is on the near side of depth steps than elsewhere.

    ``depth`` is registered to the picture and of its size; NaN without enough steps.
    """
    far = cv2.dilate(depth, np.ones((3, 3), np.uint8))
    step = (depth > 0) & (far > depth * (1 + STEP_SHARE) + STEP_M)
    if step.sum() < MIN_PIXELS:
        return np.nan
    return float(gradient[step].mean() - gradient[depth > 0].mean())
