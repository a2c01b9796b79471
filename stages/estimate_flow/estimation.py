"""Optical flow by dense inverse search (DIS, Kroeger et al. 2016), chained over growing gaps.

Coarse-to-fine search loses small things that move against the camera, so neighboring frames are searched
twice, from coarse levels and on the finest level only, and each place keeps what matches better. Search fails
altogether when the picture moves far, so longer gaps chain two flows of half the gap and search again on the
finest level from there. Make one `Estimator` per video; `flows` yields pair after pair and keeps no more than
the longest gap needs.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from pipeline.data.flow import STRIDE_PX
from pipeline.geometry import cameras

MATCH_WINDOW_PX = 5
"""side of the window over which two candidates are compared, pixels at half the reduced size"""
MATCH_MARGIN = 2.0
"""brightness difference (of 255) by which the second candidate must win: on plain walls chance suffices"""
MATCH_CLIP = 40.0
"""brightness difference (of 255) beyond which a mismatch is not worse"""

DESCENT_STEPS, GUIDED_STEPS = 50, 25
"""gradient-descent iterations per patch, without and with a guess (where more change nothing): more than
the presets' 16 to 25, for motion blur and weak texture"""
REFINEMENT_STEPS = 1
"""variational iterations of the coarse-to-fine search: they smooth walls, and from 2 on small things too"""
TOLERANCE_PX = 1.5
"""forward-backward error at which confidence is 1/e, reduced pixels"""

Gray = UInt8[np.ndarray, "working_height working_width"]
Dense = Float[np.ndarray, "dense_height dense_width 2"]
"""flow at half the reduced size, where the search ends, in pixels of that size"""


@dataclass(frozen=True)
class Flow:
    """Flow of one pair of frames, in color pixels, at the cell centers (4j + 2, 4i + 2)."""

    flow: Float[np.ndarray, "height width 2"]
    confidence: UInt8[np.ndarray, "height width"]
    """255 = the other direction leads exactly back"""


class Estimator:
    """Flow between pictures of one size."""

    def __init__(self, color_size: tuple[int, int], working_side_px: int) -> None:
        """Prepare for pictures of (height, width), the longer side reduced to ``working_side_px`` or less."""
        scale = min(1.0, working_side_px / max(color_size))
        self.dense_size = tuple(max(round(side * scale / 2), 8) for side in color_size)
        self.grid_px = grid_centers(color_size)
        self._color_size = color_size
        self._color_per_dense = (np.array(color_size) / self.dense_size)[::-1].astype(np.float32)
        self._tolerance_px = TOLERANCE_PX / scale
        # A search that was given a guess remembers it in later ones: so one of its own for those.
        self._coarse, self._fine, self._guided = (_search(fine_only=fine) for fine in (False, True, True))
        self._guided.setGradientDescentIterations(GUIDED_STEPS)
        self._pixel = (cameras.pixel_grid(*self.dense_size) - 0.5).astype(np.float32)

    def reduce(self, color: UInt8[np.ndarray, "height width 3"]) -> Gray:
        """Turn a color picture into the gray one that is searched."""
        gray = cv2.cvtColor(color, cv2.COLOR_RGB2GRAY)
        height, width = self.dense_size
        return cv2.resize(gray, (2 * width, 2 * height), interpolation=cv2.INTER_AREA)

    def neighbors(self, first: Gray, second: Gray) -> Dense:
        """Search from coarse to fine and on the finest level only; keep per place what matches better."""
        candidates = [self._searched(search, first, second) for search in (self._coarse, self._fine)]
        return self._better(first, second, candidates)

    def chained(self, first: Gray, last: Gray, first_to_middle: Dense, middle_to_last: Dense) -> Dense:
        """Follow one flow, then the other; keep per place that or a search on the finest level from there."""
        guess = chain(first_to_middle, middle_to_last)
        return self._better(first, last, [guess, self._searched(self._guided, first, last, guess)])

    def judged(self, flow: Dense, back: Dense) -> Flow:
        """Bring one flow to the stored grid, with exp(-error / tolerance) as confidence.

        The error is how far going there and back misses; what leaves the picture gets 0.
        """
        flow_px, back_px = self._on_grid(flow), self._on_grid(back)
        target_px = self.grid_px + flow_px
        error_px = np.linalg.norm(flow_px + _sampled(back_px, target_px / STRIDE_PX - 0.5), axis=-1)
        inside = ((target_px >= 0) & (target_px <= np.array(self._color_size[::-1]))).all(-1)
        confidence = np.where(inside, np.exp(-error_px / self._tolerance_px), 0)
        return Flow(flow_px.astype(np.float16), np.rint(255 * confidence).astype(np.uint8))

    def _better(self, first: Gray, second: Gray, candidates: Sequence[Dense]) -> Dense:
        """Keep the first candidate but where the second one clearly makes the pictures look more alike."""
        size, mismatch = self.dense_size[::-1], []
        first, second = (cv2.resize(gray, size, interpolation=cv2.INTER_AREA) for gray in (first, second))
        for candidate in candidates:
            difference = cv2.absdiff(_sampled(second, self._pixel + candidate), first).astype(np.float32)
            mismatch.append(cv2.blur(np.minimum(difference, MATCH_CLIP), (MATCH_WINDOW_PX, MATCH_WINDOW_PX)))
        return np.where((mismatch[1] + MATCH_MARGIN < mismatch[0])[..., None], candidates[1], candidates[0])

    def _searched(
        self, search: cv2.DISOpticalFlow, first: Gray, second: Gray, guess: Dense | None = None
    ) -> Dense:
        start = np.zeros(0, np.float32)  # an empty array is no guess
        if guess is not None:
            start = 2 * cv2.resize(guess, first.shape[::-1], interpolation=cv2.INTER_LINEAR)
        found = search.calc(first, second, start)
        return cv2.resize(found, self.dense_size[::-1], interpolation=cv2.INTER_AREA) / 2

    def _on_grid(self, dense: Dense) -> Float[np.ndarray, "height width 2"]:
        return _sampled(dense, self.grid_px / self._color_per_dense - 0.5) * self._color_per_dense


def flows(
    gray: Callable[[int], Gray], frames: int, gaps: Sequence[int], estimator: Estimator
) -> Iterator[tuple[int, Flow, Flow]]:
    """Yield (gap, forward, backward) for gaps that double from 1; ``gray(i)`` gives frame i reduced.

    The pairs of one gap come in the order of their first frames 0, 1, ...; those of all gaps mix, as soon as
    their last frame is there.
    """
    assert list(gaps) == [2**power for power in range(len(gaps))], gaps
    known: dict[tuple[int, int], tuple[Dense, Dense]] = {}
    for number in range(1, frames):
        last = gray(number)
        for gap in gaps:
            i = number - gap
            if i < 0:
                break
            first = gray(i)
            if gap == 1:
                there, back = estimator.neighbors(first, last), estimator.neighbors(last, first)
            else:
                (there_1, back_1), (there_2, back_2) = known.pop((gap // 2, i)), known[gap // 2, i + gap // 2]
                there = estimator.chained(first, last, there_1, there_2)
                back = estimator.chained(last, first, back_2, back_1)
            if gap < gaps[-1]:
                known[gap, i] = there.astype(np.float16), back.astype(np.float16)
            yield gap, estimator.judged(there, back), estimator.judged(back, there)


def chain(first_to_middle: Dense, middle_to_last: Dense) -> Dense:
    """Follow one flow, then the other."""
    middle = cameras.pixel_grid(*first_to_middle.shape[:2]) - 0.5 + first_to_middle
    return first_to_middle + _sampled(middle_to_last, middle)


def grid_centers(color_size: tuple[int, int]) -> Float[np.ndarray, "height width 2"]:
    """Return the pixel positions (x, y) of the stored vectors for pictures of (height, width)."""
    cells = cameras.pixel_grid(*(side // STRIDE_PX for side in color_size))
    return (cells * STRIDE_PX).astype(np.float32)


def _sampled(image: np.ndarray, index: Float[np.ndarray, "height width 2"]) -> np.ndarray:
    """Read an image between its pixels at (x, y) indices; beyond the border it goes on as it ends."""
    image = image.astype(np.float32) if image.dtype == np.float16 else image
    index = index.astype(np.float32)
    return cv2.remap(image, index[..., 0], index[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)


def _search(*, fine_only: bool) -> cv2.DISOpticalFlow:
    search = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    search.setFinestScale(1)
    if fine_only:
        search.setCoarsestScale(1)
    search.setGradientDescentIterations(DESCENT_STEPS)
    search.setVariationalRefinementIterations(0 if fine_only else REFINEMENT_STEPS)
    return search
