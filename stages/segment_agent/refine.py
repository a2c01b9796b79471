"""Refine coarse evidence to a sharp mask by color and image edges.

Evidence is a log-odds image of a window around the animal; a guided filter transfers image edges to it where
depth is missing. `ColorHistogram` models the animal's colors over the recording; the room's come from the
window.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import scipy.ndimage
from jaxtyping import Bool, Float, Int, UInt8

from pipeline.geometry import picture_fit


@dataclass(frozen=True)
class Edges:
    """Parameters of refinement."""

    radius_px: int = 1
    """radius of the guided filter at working resolution"""
    unsure: float = 0.5
    """magnitude of log-odds below which a boundary pixel is unknown"""


EDGE = 0.1
"""standard deviation of color (0..1) below which the guided filter smooths"""
BINS, AB_RANGE = 12, 96
"""histogram bins along each axis of Lab, and the range of a and b that they cover"""
MIN_COLORS, PRIOR, PRIOR_BINS, SMOOTHING = 50, 0.02, 200, (0.25, 0.5, 0.25)
"""minimum pixels of a histogram; weight of its uniform prior, and bins that share it; smoothing kernel"""
MIN_CERTAINTY = 0.05
"""filtered certainty below which evidence fades"""
SURE_SHARE, HOLE_SHARE, MOVED_SHARE = 0.05, 0.05, 0.2
"""minimum share of sure pixels in a component; largest hole that is filled, as a share of the mask; share of
a component seen through at other times for which it is animal whatever it looks like"""


class ColorHistogram:
    """Lab color histogram of the animal over a whole recording."""

    def __init__(self) -> None:
        self._counts = np.zeros((BINS, BINS, BINS), np.float32)

    def learn(self, color: UInt8[np.ndarray, "pixel 3"]) -> None:
        """Add the colors of pixels that surely show the animal."""
        np.add.at(self._counts, _bin(color), 1.0)

    def log_likelihood_ratio(
        self, color: UInt8[np.ndarray, "height width 3"], room: Bool[np.ndarray, "height width"]
    ) -> Float[np.ndarray, "height width"]:
        """Return log p(color | animal) / p(color | room), within +-2; ``room`` marks certain background."""
        if min(self._counts.sum(), room.sum()) < MIN_COLORS:
            return np.zeros(color.shape[:2], np.float32)
        counts = np.zeros_like(self._counts)
        np.add.at(counts, _bin(color[room]), 1.0)
        animal, background = _density(self._counts), _density(counts)
        bins = _bin(color.reshape(-1, 3))
        log_ratio = np.log(animal[bins] / background[bins])
        return np.clip(log_ratio, -2, 2).reshape(color.shape[:2]).astype(np.float32)


def sharpen(
    evidence: Float[np.ndarray, "height width"],
    certainty: Float[np.ndarray, "height width"],
    color: UInt8[np.ndarray, "height width 3"],
    edges: Edges,
) -> Float[np.ndarray, "height width"]:
    """Filter log-odds guided by the image: uncertain pixels follow neighbors of similar color."""
    guide = cv2.GaussianBlur(color, (3, 3), 0).astype(np.float32) / 255
    both = np.dstack([evidence * certainty, certainty]).astype(np.float32)
    filtered = cv2.ximgproc.guidedFilter(guide, both, edges.radius_px, EDGE**2)
    return filtered[..., 0] / np.maximum(filtered[..., 1], MIN_CERTAINTY)


def label(
    log_odds: Float[np.ndarray, "height width"], sure: Bool[np.ndarray, "height width"], edges: Edges
) -> UInt8[np.ndarray, "height width"]:
    """Label 255 / 0 / 128: keep components with sure pixels, fill holes, weak boundaries are unknown."""
    inside = (log_odds > 0).astype(np.uint8)
    component, area = _components(inside, 8)
    held = np.bincount(component[sure], minlength=len(area)) > np.maximum(3, SURE_SHARE * area)
    held[0] = False
    inside = held[component].astype(np.uint8)
    hole, area = _components(1 - inside, 4)
    small = area < HOLE_SHARE * max(int(inside.sum()), 1)
    small[0] = False
    inside[small[hole]] = 1
    cross = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (5, 5))
    rim = cv2.dilate(inside, cross) != cv2.erode(inside, cross)
    mask = np.where(inside > 0, 255, 0).astype(np.uint8)
    mask[rim & (np.abs(log_odds) < edges.unsure)] = 128
    return mask


def remove_strays(
    labels: UInt8[np.ndarray, "height width"],
    log_ratio: Float[np.ndarray, "height width"],
    seen_through: Bool[np.ndarray, "height width"],
) -> UInt8[np.ndarray, "height width"]:
    """Remove components, except the largest, that look like the room and of which little is seen through."""
    component, area = _components((labels > 0).astype(np.uint8), 8)
    if len(area) < 3:
        return labels
    stray = np.bincount(component.ravel(), log_ratio.ravel(), len(area)) < 0
    stray &= np.bincount(component.ravel(), seen_through.ravel(), len(area)) < MOVED_SHARE * area
    stray[[0, 1 + area[1:].argmax()]] = False
    return np.where(stray[component], 0, labels).astype(np.uint8)


def _components(
    inside: UInt8[np.ndarray, "height width"], connectivity: int
) -> tuple[Int[np.ndarray, "height width"], Int[np.ndarray, "part"]]:
    """Return the connected component of each pixel (0: none) and the components' areas."""
    _, component, stats, _ = cv2.connectedComponentsWithStats(inside, connectivity=connectivity)
    return np.asarray(component, np.int32), stats[:, cv2.CC_STAT_AREA]


def _bin(color: UInt8[np.ndarray, "pixel 3"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return Lab bins; lightness is coarser than color to tolerate shading."""
    lab = picture_fit.lab(color.reshape(1, -1, 3))[0].astype(np.int32)
    light = lab[:, 0] * (BINS - 1) // 255
    tone = np.clip((lab[:, 1:] - 128) * BINS // AB_RANGE + BINS // 2, 0, BINS - 1)
    return light, tone[:, 0], tone[:, 1]


def _density(counts: Float[np.ndarray, "light a b"]) -> Float[np.ndarray, "light a b"]:
    smooth = counts
    for axis in range(3):
        smooth = scipy.ndimage.convolve1d(smooth, SMOOTHING, axis, mode="nearest")
    total = smooth.sum()
    return (smooth + PRIOR * max(total, 1) / PRIOR_BINS) / (total * (1 + PRIOR * smooth.size / PRIOR_BINS))
