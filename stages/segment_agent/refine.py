"""Turn coarse evidence into a sharp mask: depth evidence, colour, and edges of the picture.

Everything is a log-odds picture of a window around the animal; a guided filter lets the colour picture's
edges decide where depth is missing. `Palette` learns the animal's colours over the recording, the window's
rest gives the room's.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8


@dataclass(frozen=True)
class Edges:
    """How sharply evidence becomes a mask."""

    radius_px: int = 1
    """reach of the edge-preserving filter at working resolution"""
    unsure: float = 0.5
    """log-odds below which a pixel at the boundary is unknown"""


EDGE = 0.1
"""colour variance (0..1 squared) below which the filter smooths, as its root"""
BINS, TONES = 12, 96
"""of a histogram along each axis of Lab, and the range of a and b that they divide"""
MIN_COLORS, PRIOR, PRIOR_BINS = 50, 0.02, 200
"""pixels without which there is no palette, and the share of all that every so many unseen bins count as"""
MIN_CERTAINTY = 0.05
"""below, filtered evidence fades"""
SURE_SHARE, HOLE_SHARE = 0.05, 0.05
"""share of a part that must be sure, and of the mask up to which a hole is closed"""


class Palette:
    """Colour histograms in Lab of the animal over a whole recording."""

    def __init__(self) -> None:
        self._counts = np.zeros((BINS, BINS, BINS), np.float32)

    def learn(self, color: UInt8[np.ndarray, "pixel 3"]) -> None:
        """Add the colours of pixels that surely show the animal."""
        np.add.at(self._counts, _bin(color), 1.0)

    def ratio(
        self, color: UInt8[np.ndarray, "height width 3"], room: Bool[np.ndarray, "height width"]
    ) -> Float[np.ndarray, "height width"]:
        """Return log p(colour | animal) / p(colour | room), within +-2; ``room`` marks sure room."""
        if min(self._counts.sum(), room.sum()) < MIN_COLORS:
            return np.zeros(color.shape[:2], np.float32)
        counts = np.zeros_like(self._counts)
        np.add.at(counts, _bin(color[room]), 1.0)
        animal, around = _density(self._counts), _density(counts)
        where = _bin(color.reshape(-1, 3))
        return (
            np.clip(np.log(animal[where] / around[where]), -2, 2).reshape(color.shape[:2]).astype(np.float32)
        )


def sharpen(
    evidence: Float[np.ndarray, "height width"],
    certainty: Float[np.ndarray, "height width"],
    color: UInt8[np.ndarray, "height width 3"],
    edges: Edges,
) -> Float[np.ndarray, "height width"]:
    """Spread log-odds along the picture: where certainty is low the neighbours of like colour decide."""
    guide = cv2.GaussianBlur(color, (3, 3), 0).astype(np.float32) / 255
    both = np.dstack([evidence * certainty, certainty]).astype(np.float32)
    filtered = cv2.ximgproc.guidedFilter(guide, both, edges.radius_px, EDGE**2)
    return filtered[..., 0] / np.maximum(filtered[..., 1], MIN_CERTAINTY)


def label(
    log_odds: Float[np.ndarray, "height width"], sure: Bool[np.ndarray, "height width"], edges: Edges
) -> UInt8[np.ndarray, "height width"]:
    """Decide 255 / 0 / 128: parts that hold sure pixels stay, holes close, a weak boundary is unknown."""
    inside = (log_odds > 0).astype(np.uint8)
    parts, area = _parts(inside, 8)
    held = np.bincount(parts[sure], minlength=len(area)) > np.maximum(3, SURE_SHARE * area)
    held[0] = False
    inside = held[parts].astype(np.uint8)
    inside = _fill_holes(inside, limit=HOLE_SHARE)
    cross = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (5, 5))
    rim = cv2.dilate(inside, cross) != cv2.erode(inside, cross)
    mask = np.where(inside > 0, 255, 0).astype(np.uint8)
    mask[rim & (np.abs(log_odds) < edges.unsure)] = 128
    return mask


def without_strays(
    labels: UInt8[np.ndarray, "height width"], like: Float[np.ndarray, "height width"]
) -> UInt8[np.ndarray, "height width"]:
    """Take away parts, but for the largest, that look rather like the room: rims that seem to move."""
    parts, area = _parts((labels > 0).astype(np.uint8), 8)
    if len(area) < 3:
        return labels
    stray = np.bincount(parts.ravel(), like.ravel(), len(area)) / area < 0
    stray[[0, 1 + area[1:].argmax()]] = False
    return np.where(stray[parts], 0, labels).astype(np.uint8)


def _parts(
    inside: UInt8[np.ndarray, "height width"], connectivity: int
) -> tuple[Int[np.ndarray, "height width"], Int[np.ndarray, "part"]]:
    """Return the connected part of each pixel (0: none) and the parts' areas."""
    _, parts, stats, _ = cv2.connectedComponentsWithStats(inside, connectivity=connectivity)
    return np.asarray(parts, np.int32), stats[:, cv2.CC_STAT_AREA]


def _fill_holes(inside: UInt8[np.ndarray, "height width"], limit: float) -> UInt8[np.ndarray, "height width"]:
    """Close holes smaller than a share of the whole."""
    parts, area = _parts(1 - inside, 4)
    small = area < limit * max(int(inside.sum()), 1)
    small[0] = False
    return np.where(small[parts], 1, inside).astype(np.uint8)


def _bin(color: UInt8[np.ndarray, "pixel 3"]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Lab bins; lightness is coarser than colour so that shade matters less."""
    lab = cv2.cvtColor(np.ascontiguousarray(color.reshape(1, -1, 3)), cv2.COLOR_RGB2LAB)[0].astype(np.int32)
    light = lab[:, 0] * (BINS - 1) // 255
    tone = np.clip((lab[:, 1:] - 128) * BINS // TONES + BINS // 2, 0, BINS - 1)
    return light, tone[:, 0], tone[:, 1]


def _density(counts: Float[np.ndarray, "light a b"]) -> Float[np.ndarray, "light a b"]:
    smooth = counts
    for axis in range(3):
        padded = np.pad(smooth, [(1, 1) if a == axis else (0, 0) for a in range(3)], mode="edge")
        lower, upper = np.delete(padded, [-1, -2], axis), np.delete(padded, [0, 1], axis)
        smooth = 0.5 * smooth + 0.25 * (lower + upper)
    return (smooth + PRIOR * max(smooth.sum(), 1) / PRIOR_BINS) / (
        smooth.sum() * (1 + PRIOR * smooth.size / PRIOR_BINS)
    )
