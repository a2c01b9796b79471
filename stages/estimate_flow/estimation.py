"""Dense inverse search (DIS, Kroeger et al. 2016) on a coarse grid, with forward-backward confidence.

Make one `Estimator` per video; `between` estimates both directions of one pair of gray pictures.
"""

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8

STRIDE_PX = 4
"""colour pixels per stored flow vector"""


@dataclass(frozen=True)
class Search:
    """How hard to search; pixels are those of the reduced pictures."""

    working_side_px: int
    """longer side of the reduced pictures"""
    finest_scale: int
    """pyramid level at which the search ends, 0 = full size"""
    patch_stride_px: int
    """distance between patches"""
    iterations: int
    """descent steps per patch"""
    refinements: int
    """variational smoothing steps afterwards"""


@dataclass(frozen=True)
class Flow:
    """Flow of several pairs of frames, in colour pixels, at the cell centres (4j + 2, 4i + 2)."""

    flow: Float[np.ndarray, "frame height width 2"]
    confidence: UInt8[np.ndarray, "frame height width"]
    """255 = the other direction leads exactly back"""


class Estimator:
    """Flow between pictures of one size."""

    def __init__(self, color_size: tuple[int, int], search: Search, *, tolerance_px: float) -> None:
        """Prepare for pictures of (height, width); the confidence falls to 1/e at ``tolerance_px`` reduced pixels."""
        self._scale = min(1.0, search.working_side_px / max(color_size))
        self._working = tuple(max(round(side * self._scale), 16) for side in color_size)
        self._size = color_size
        self._tolerance_px = tolerance_px / self._scale
        self.grid_px = grid_centers(color_size)
        self._search = _search(search)

    def reduce(self, color: UInt8[np.ndarray, "height width 3"]) -> UInt8[np.ndarray, "working_height working_width"]:
        """Turn a colour picture into the gray one that is searched."""
        gray = cv2.cvtColor(color, cv2.COLOR_RGB2GRAY)
        return gray if self._scale == 1 else cv2.resize(gray, self._working[::-1], interpolation=cv2.INTER_AREA)

    def between(
        self,
        first: UInt8[np.ndarray, "working_height working_width"],
        second: UInt8[np.ndarray, "working_height working_width"],
    ) -> tuple[Flow, Flow]:
        """Return (first to second, second to first); each holds one pair."""
        forward, backward = self._on_grid(first, second), self._on_grid(second, first)
        return self._judged(forward, backward), self._judged(backward, forward)

    def _on_grid(self, first: np.ndarray, second: np.ndarray) -> Float[np.ndarray, "height width 2"]:
        """Search at working size, then average to the stored grid in colour pixels."""
        dense = self._search.calc(first, second, None)
        per_working_px = np.array(self._size[::-1], np.float32) / np.array(self._working[::-1], np.float32)
        at = (self.grid_px / per_working_px - 0.5).astype(np.float32)
        blurred = cv2.blur(dense, (3, 3))
        return (
            cv2.remap(blurred, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
            * per_working_px
        )

    def _judged(self, flow: Float[np.ndarray, "height width 2"], back: Float[np.ndarray, "height width 2"]) -> Flow:
        """Attach exp(-error / tolerance), where error is how far going there and back misses; 0 outside the picture."""
        target_px = self.grid_px + flow
        cell = (target_px / STRIDE_PX - 0.5).astype(np.float32)
        there = cv2.remap(back, cell[..., 0], cell[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        error_px = np.linalg.norm(flow + there, axis=-1)
        inside = ((target_px >= 0) & (target_px <= np.array(self._size[::-1]))).all(-1)
        confidence = np.where(inside, np.exp(-error_px / self._tolerance_px), 0)
        return Flow(flow[None].astype(np.float16), np.rint(255 * confidence)[None].astype(np.uint8))


def grid_centers(color_size: tuple[int, int]) -> Float[np.ndarray, "height width 2"]:
    """Return the pixel positions (x, y) of the stored vectors for pictures of (height, width)."""
    x, y = np.meshgrid(*(np.arange(side // STRIDE_PX) * STRIDE_PX + STRIDE_PX / 2 for side in color_size[::-1]))
    return np.stack([x, y], axis=-1).astype(np.float32)


def flow_of_gap(
    gray: Callable[[int], UInt8[np.ndarray, "working_height working_width"]],
    frames: int,
    gap: int,
    estimator: Estimator,
) -> tuple[Flow, Flow]:
    """Estimate flow between all frames ``gap`` apart; ``gray(i)`` gives frame i reduced.

    Returns (forward, backward); entry i of both belongs to frames i and i + gap. Empty when the clip is too short.
    """
    pairs = [estimator.between(gray(i), gray(i + gap)) for i in range(frames - gap)]
    return tuple(_stacked([pair[way] for pair in pairs], estimator) for way in (0, 1))


def _stacked(flows: list[Flow], estimator: Estimator) -> Flow:
    height, width = estimator.grid_px.shape[:2]
    if not flows:
        return Flow(np.zeros((0, height, width, 2), np.float16), np.zeros((0, height, width), np.uint8))
    return Flow(np.concatenate([flow.flow for flow in flows]), np.concatenate([flow.confidence for flow in flows]))


def _search(settings: Search) -> cv2.DISOpticalFlow:
    search = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    search.setFinestScale(settings.finest_scale)
    search.setPatchStride(settings.patch_stride_px)
    search.setGradientDescentIterations(settings.iterations)
    search.setVariationalRefinementIterations(settings.refinements)
    return search
