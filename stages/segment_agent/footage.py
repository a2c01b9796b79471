"""Pictures, flow and motion against the background of a recording without depth, at working size."""

from dataclasses import dataclass, field
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from pipeline.data.clips import Clip
from pipeline.data.flow import GAPS, open_confidence, open_flow
from pipeline.geometry import cameras
from pipeline.segmentation.grabcut import Region, dilated
from stages.segment_agent.windows import working_picture, working_size

SPARSE_PX, INLIER_PX, MIN_CONFIDENCE = 8, 2.0, 0.3
"""background homography: pixel spacing, inlier threshold, minimum flow confidence"""
MOVING, STILL = 4.0, 2.5
"""normalized residual above which a point moves against the background, and below which it is static"""
SEARCH_PX, OUTLINE_PX = 16, 3
"""search radius around the propagated mask, and how far flow blurs outlines; working pixels"""
MIN_MOVING = 0.3
"""share of a region that must move for motion to be used"""
MIN_TYPICAL_PX = 0.5
"""least median residual used for normalization: noise of the flow"""
SHOWN_GAPS, SHOWN_LOG = (1, 4), 60.0
"""frame gaps of the motion channels; 8-bit levels per log(1 + residual), saturating at a residual of 70"""


@dataclass(frozen=True)
class Footage:
    """Pictures at working size and flow at the same size."""

    clip: Clip
    flow: Path
    height_px: int
    _residuals: dict[tuple[int, int], np.ndarray] = field(default_factory=dict)

    @property
    def size(self) -> tuple[int, int]:
        """(height, width) of working pictures."""
        return working_size(self.clip, self.height_px)

    def color(self, frame: int) -> UInt8[np.ndarray, "height width 3"]:
        """Read a working picture."""
        return working_picture(self.clip, frame, self.height_px)

    def flow_between(self, frame: int, other: int) -> Float[np.ndarray, "height width 2"] | None:
        """Read the flow from a frame to another, working pixels; None where none is stored."""
        first, gap = min(frame, other), abs(other - frame)
        table = open_flow(self.flow, gap, backward=other < frame)
        if not 0 <= first < len(table):
            return None
        scale = self.size[0] / self.clip.color_size[0]
        return scale * self._resized(table[first].astype(np.float32))

    def confidence(self, frame: int, other: int) -> Float[np.ndarray, "height width"]:
        """Read the forward-backward consistency of a stored flow, 0..1."""
        table = open_confidence(self.flow, abs(other - frame), backward=other < frame)
        return self._resized(table[min(frame, other)]).astype(np.float32) / 255

    def residual(self, frame: int, *gaps: int) -> Float[np.ndarray, "height width"]:
        """Return the flow residual against the background over frame gaps, in units of its median.

        The background moves by a homography fitted to most of the picture. Mean over both time directions.
        """
        pixel, parts = (cameras.pixel_grid(*self.size) - 0.5).astype(np.float32), []
        for other in (frame + sign * gap for gap in gaps for sign in (-1, 1)):
            moved = self.flow_between(frame, other)
            if moved is None:
                continue
            agreed = self.confidence(frame, other)[::SPARSE_PX, ::SPARSE_PX] > MIN_CONFIDENCE
            sparse, sparse_flow = (part[::SPARSE_PX, ::SPARSE_PX][agreed] for part in (pixel, moved))
            few = len(sparse) < 4
            matrix = None if few else cv2.findHomography(sparse, sparse + sparse_flow, cv2.RHO, INLIER_PX)[0]
            if matrix is not None:
                expected = cv2.perspectiveTransform(pixel.reshape(1, -1, 2), matrix).reshape(pixel.shape)
                error = np.linalg.norm(expected - pixel - moved, axis=-1)
                parts.append(error / max(float(np.median(error)), MIN_TYPICAL_PX))
        return np.mean(parts, axis=0) if parts else np.zeros(self.size, np.float32)

    def moving(self, frame: int, inside: Region) -> Float[np.ndarray, "height width"]:
        """Return 1 near ``inside`` where pixels move against the background like it, -1 where they do not.

        0 between, and everywhere if little of ``inside`` moves or much of the rest does, like water. The
        shortest gap with enough motion is used, since flow blurs outlines more over longer ones.
        """
        far = ~dilated(inside, SEARCH_PX)
        for gap in GAPS:
            residual = self._residual_over(frame, gap)
            moves = residual[inside & (residual > MOVING)]
            if len(moves) > MIN_MOVING * inside.sum():
                level = float(np.median(moves))
                moving = ~dilated(residual < max(MOVING, level / 2), OUTLINE_PX)
                alone = moving[far].sum() < MIN_MOVING / 2 * far.sum()
                return (moving.astype(np.float32) - (residual < max(STILL, level / 4))) * (alone & ~far)
        return np.zeros(self.size, np.float32)

    def with_motion(self, frame: int) -> UInt8[np.ndarray, "height width 5"]:
        """Return a working picture with two motion channels: log residuals against the background."""
        residual = np.stack([self._residual_over(frame, gap) for gap in SHOWN_GAPS], -1)
        shown = np.minimum(SHOWN_LOG * np.log1p(residual.astype(np.float32)), 255)
        return np.concatenate([self.color(frame), shown.astype(np.uint8)], -1)

    def _residual_over(self, frame: int, gap: int) -> np.ndarray:
        if (frame, gap) not in self._residuals:
            small = np.minimum(self.residual(frame, gap), np.finfo(np.float16).max)
            self._residuals[frame, gap] = small.astype(np.float16)
        return self._residuals[frame, gap]

    def _resized(self, image: np.ndarray) -> np.ndarray:
        return cv2.resize(image, self.size[::-1], interpolation=cv2.INTER_LINEAR)
