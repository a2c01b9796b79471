"""Dense, weight-free picture features: DAISY (Tola et al. 2010) on a grid, in a shared linear basis.

`describe` turns a picture into raw descriptors, `fit_basis` finds the basis on those of many recordings, and
`FeatureBasis.project` gives the 16 unit-length channels that fields, templates and losses use. Gradients
normalized per patch make them blind to exposure and white balance.

Chosen by measurement (`benchmarks.descriptors`): with 16 channels 0.120 of the cells of a real kitchen find
their true cell in another view, as many as by dense SIFT in three times the seconds; multiple kernel
descriptors and VGG find fewer, and so does DAISY of radius 8 with partial normalization.
"""

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from pipeline.data.features import BASIS, CHANNELS

WHITENING = 0.5
"""between the variance of each axis (0) and equal axes (1): strong axes do not drown the others, noise stays
small"""
WORKING_SIDE_PX = 320
"""pictures with a longer side are reduced to it, so that phones of any resolution are described alike"""
RADIUS_PX = 16
"""radius of a descriptor, reduced pixels"""
MARGIN_PX = 24
"""mirrored around a picture: a descriptor's radius and its smoothing, reduced pixels"""


def describe(
    color: UInt8[np.ndarray, "height width 3"], stride_px: int
) -> Float[np.ndarray, "rows columns channel"]:
    """Describe a picture at the cell centers (stride * (j + 1/2), stride * (i + 1/2)) of its own pixels.

    Descriptors have unit length; cells without any texture are zero.
    """
    gray = cv2.cvtColor(color, cv2.COLOR_RGB2GRAY)
    scale = min(1.0, WORKING_SIDE_PX / max(gray.shape))
    if scale < 1:
        gray = cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    # Beyond its edge a picture goes on as its mirror image: an edge at the border would be the strongest of
    # all.
    gray = np.pad(gray, MARGIN_PX, "reflect")
    rows, columns = color.shape[0] // stride_px, color.shape[1] // stride_px
    raw = _daisy().compute(gray, _grid(rows, columns, stride_px, scale))[1].reshape(rows, columns, -1)
    return _unit(np.nan_to_num(raw, nan=0.0, posinf=0.0, neginf=0.0))


@dataclass(frozen=True)
class FeatureBasis:
    """Linear projection of raw descriptors, shared by all recordings of an agent."""

    mean: Float[np.ndarray, "channel"]
    components: Float[np.ndarray, "16 channel"]
    """principal axes, already divided by the square root of their standard deviation"""
    scale: float
    """median length of projections before they are normalized"""
    explained: Float[np.ndarray, "16"]
    """share of the variance along each axis"""

    @classmethod
    def load(cls, folder: Path) -> "FeatureBasis":
        """Open a finished ``feature_basis`` artifact."""
        table = BASIS.load(folder / "basis.npz")
        return cls(table["mean"], table["components"], float(table["scale"]), table["explained"])

    def save(self, folder: Path) -> None:
        """Write ``basis.npz``."""
        BASIS.save(folder / "basis.npz", **vars(self))

    def project(self, raw: Float[np.ndarray, "*cell channel"]) -> Float[np.ndarray, "*cell 16"]:
        """Return unit-length features of raw descriptors."""
        return _unit((raw - self.mean) @ self.components.T)


def fit_basis(raw: Float[np.ndarray, "sample channel"], *, whitening: float = WHITENING) -> FeatureBasis:
    """Fit principal axes; ``whitening`` 0 keeps each axis's variance, 1 makes all equal.

    Textureless samples (zero descriptors) are left out.
    """
    samples = raw[np.linalg.norm(raw, axis=1) > 0].astype(np.float64)
    assert len(samples) > CHANNELS, len(samples)
    mean = samples.mean(axis=0)
    variance, axes = np.linalg.eigh(np.cov(samples - mean, rowvar=False))
    variance, axes = variance[::-1][:CHANNELS], axes.T[::-1][:CHANNELS]
    sign = np.sign(np.take_along_axis(axes, np.abs(axes).argmax(axis=1, keepdims=True), axis=1))
    components = sign * axes / np.maximum(variance, 1e-12)[:, None] ** (whitening / 2)
    length = np.linalg.norm((samples - mean) @ components.T, axis=1)
    explained = variance / np.var(samples, axis=0, ddof=1).sum()
    mean, components, explained = (part.astype(np.float32) for part in (mean, components, explained))
    return FeatureBasis(mean, components, float(np.float32(np.median(length))), explained)


def _unit(vectors: np.ndarray) -> Float[np.ndarray, "*cell channel"]:
    return (vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-6)).astype(np.float32)


@lru_cache(maxsize=1)
def _daisy() -> cv2.xfeatures2d.DAISY:
    return cv2.xfeatures2d.DAISY.create(RADIUS_PX, 2, 6, 8, cv2.xfeatures2d.DAISY_NRM_SIFT)


@lru_cache(maxsize=8)
def _grid(rows: int, columns: int, stride_px: int, scale: float) -> list[cv2.KeyPoint]:
    """Cell centers in the widened picture as OpenCV key points, whose integer positions are pixel centers."""
    y, x = (((np.arange(count) + 0.5) * stride_px * scale - 0.5 + MARGIN_PX) for count in (rows, columns))
    return [cv2.KeyPoint(float(column), float(row), 2 * RADIUS_PX) for row in y for column in x]
