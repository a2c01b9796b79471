"""The level surface under something that stands on it, in a world with +y up."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float


@dataclass(frozen=True)
class Ground:
    """A nearly level plane: ``height(x, z) = offset + slope . (x, z)``."""

    offset_m: float
    slope: Float[np.ndarray, "2"]

    def above(self, points_world: Float[np.ndarray, "*shape 3"]) -> Float[np.ndarray, "*shape"]:
        """Return heights above the ground."""
        return points_world[..., 1] - self.offset_m - points_world[..., [0, 2]] @ self.slope


def fit_ground(points_world: Float[np.ndarray, "point 3"], focus: Float[np.ndarray, "3"], reach_m: float = 0.5) -> Ground:
    """Fit the surface below the focus that most upward-facing points near it lie on; ``reach_m`` is how far aside counts."""
    aside = np.linalg.norm((points_world - focus)[:, [0, 2]], axis=1)
    height = points_world[:, 1]
    weight = np.exp(-((aside / reach_m) ** 2)) * (height < focus[1] + 0.05)
    counts, edges = np.histogram(height, np.arange(height.min() - 0.02, height.max() + 0.04, 0.02), weights=weight)
    offset, slope = edges[counts.argmax()] + 0.01, np.zeros(2)
    for band in (0.05, 0.03, 0.02):
        close = np.abs(height - offset - points_world[:, [0, 2]] @ slope) < band
        design = np.column_stack([points_world[close][:, [0, 2]], np.ones(close.sum())]) * weight[close, None]
        solution = np.linalg.lstsq(design, height[close] * weight[close], rcond=None)[0]
        slope, offset = solution[:2], solution[2]
    return Ground(float(offset), slope)
