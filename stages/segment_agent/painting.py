"""One sharp mask per frame: where the ball is, the judge's evidence and the animal's looks decide together."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from pipeline.files.clips import Clip
from stages.segment_agent import refine
from stages.segment_agent.appearance import Appearance
from stages.segment_agent.evidence import Evidence, Judge
from stages.segment_agent.refine import Palette, Refinement
from stages.segment_agent.windows import Sphere, Window, cut, working_picture, working_size


@dataclass(frozen=True)
class Mask:
    """One frame's result at colour resolution."""

    labels: UInt8[np.ndarray, "height width"]
    visible: bool
    confidence: float


@dataclass(frozen=True)
class Painter:
    """Makes masks of one recording."""

    clip: Clip
    world_from_camera: Float[np.ndarray, "frame 4 4"]
    balls: list[Sphere | None]
    judge: Judge
    options: Refinement
    looks: Palette | Appearance

    def masks(self, frames: Iterable[int]) -> Iterator[Mask]:
        """Make one mask per frame, in order, at colour resolution."""
        for frame in frames:
            mask = self.working_mask(frame)
            labels = mask.labels
            if labels.shape != self.clip.color_size:
                labels = cv2.resize(labels, self.clip.color_size[::-1], interpolation=cv2.INTER_NEAREST)
            yield Mask(labels, mask.visible, mask.confidence)

    def working_mask(self, frame: int) -> Mask:
        """Make one mask at working resolution."""
        empty = np.zeros(working_size(self.clip, self.options.height_px), np.uint8)
        ball = self.balls[frame]
        if ball is None:
            return Mask(empty, False, 1.0)
        color = working_picture(self.clip, frame, self.options.height_px)
        window = cut(self.clip, frame, self.world_from_camera[frame], ball, color)
        if window is None:
            return Mask(empty, False, 1.0)
        evidence = self.judge(frame, window, ball)
        match self.looks:
            case Palette() as palette:
                log_odds = evidence.log_odds + self.options.color_weight * palette.ratio(window.color, evidence.room)
                log_odds = refine.sharpen(log_odds, evidence.certainty, window.color, self.options)
                sure = evidence.animal
                labels = refine.label(log_odds, sure, self.options)
            case Appearance() as network:
                labels, sure = self._by_looks(window, evidence, network.log_odds_within(color, window.rows, window.columns))
        least = self.options.least_presumed_px if ball.presumed else 1
        if sure[labels == 255].sum() < least:
            return Mask(empty, False, 0.5)
        empty[window.rows, window.columns] = labels
        return Mask(empty, True, float(sure[labels == 255].mean()))

    def _by_looks(
        self, window: Window, evidence: Evidence, like: Float[np.ndarray, "height width"]
    ) -> tuple[UInt8[np.ndarray, "height width"], Bool[np.ndarray, "height width"]]:
        """Return labels and what is sure, by evidence and learnt looks.

        A small mask must be well backed, since chance makes small ones; and as a small view lies at steps of depth all over,
        what moves clearly there is sure too if no mask is found without it.
        """
        options = self.options
        known = refine.sharpen(evidence.log_odds, evidence.certainty, window.color, options)
        most = np.where(evidence.certainty < 0.3, options.looks_alone, options.looks_for)
        log_odds = known + np.clip(options.looks_weight * like, -options.looks_against, most) - options.doubt
        strict = (log_odds > options.sure) & (evidence.animal | (like > 0))
        for sure, enough_px in ((strict, options.small_px), (strict | ((log_odds > options.sure) & evidence.clear), np.inf)):
            labels = refine.without_strays(refine.label(log_odds, sure, options), like)
            inside = labels == 255
            if inside.sum() >= enough_px or (inside.any() and ((like > 0) | evidence.clear)[inside].mean() >= options.backed):
                return labels, sure
        return np.zeros_like(labels), sure


def learn_palette(painter: Painter, pictures: int = 30) -> Palette:
    """Learn the animal's colours from frames spread over the recording."""
    palette = Palette()
    seen = [frame for frame, ball in enumerate(painter.balls) if ball is not None and not ball.presumed]
    for frame in seen[:: max(1, len(seen) // pictures)]:
        window = _window(painter, frame)
        if window is not None:
            sure = painter.judge(frame, window, painter.balls[frame]).animal.astype(np.uint8)
            palette.learn(window.color[cv2.erode(sure, np.ones((3, 3), np.uint8)) > 0])
    return palette


def _window(painter: Painter, frame: int) -> Window | None:
    color = working_picture(painter.clip, frame, painter.options.height_px)
    return cut(painter.clip, frame, painter.world_from_camera[frame], painter.balls[frame], color)
