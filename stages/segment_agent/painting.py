"""One sharp mask per frame, by where the ball is, the judge's evidence and the animal's appearance."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from pipeline.data.clips import Clip
from stages.segment_agent import refine
from stages.segment_agent.appearance import Appearance
from stages.segment_agent.evidence import Evidence, Judge
from stages.segment_agent.refine import Edges, Palette
from stages.segment_agent.windows import Sphere, Window, cut, working_picture, working_size

COLOR_WEIGHT = 0.7
"""log-odds per unit of the colours' log-ratio"""
APPEARANCE_WEIGHT, APPEARANCE_WEIGHT_BLIND = 0.3, 0.6
"""weight of the learned appearance's log-odds beside geometry, and where geometry is silent"""
APPEARANCE_ALONE, APPEARANCE_AGAINST = 3.0, 4.0
"""largest log-odds by which it speaks for the animal where geometry knows nothing (elsewhere it does not: the
edges of geometry are sharper), and against it anywhere"""
DOUBT = 0.2
"""log-odds by which a pixel is rather room, beside the learned appearance"""
SURE = 1.0
"""log-odds from which on a pixel is surely animal, beside the learned appearance"""
SMALL_PX, BACKED = 250, 0.7
"""pixels below which chance makes masks; share of them that must look like the animal or move clearly"""
MIN_PRESUMED_PX = 25
"""sure pixels that a frame needs in which the track was lost"""
PRESENCE_PRESUMED = -2.5
PRESENCE_TRACKED = 2.0
PRESENCE_APPEARANCE = 1.0
PRESENCE_MOVED = 3.0
PRESENCE_LIMIT = 4.0
"""log-odds that a mask shows the animal: without evidence; more where it was tracked and its place is not
only guessed; per unit of its mean appearance, which is limited; and where all of it clearly moved"""
ABSENT_PRESUMED, ABSENT_TRACKED, ABSENT_UNTRACKED = 0.88, 0.04, 0.99
"""probability that the animal covers less than 0.1 % of the view where nothing looks like it: at a place that
was only guessed, on its track, and where no track says where to look; counted in two semi-real kitchens and
six sessions of the built-in cat (456 of 518, 0 of 22, 183 of 183), one right and one wrong added"""
LOG_ODDS_LIMIT = 5.0
"""log-odds beyond which nothing is certain"""
FOUND_CALIBRATION, MISSED_CALIBRATION = (0.5, 2.5), (-1.0, 0.7)
"""offset and slope that make log-odds of presence probabilities, found on semi-real sequences: a mask that
passes is hardly ever wrong, while an animal that is just coming into view is often missed"""
UNKNOWN = 0.3
"""certainty below which geometry knows nothing"""


@dataclass(frozen=True)
class Mask:
    """One frame's result at colour resolution."""

    labels: UInt8[np.ndarray, "height width"]
    visible: bool
    confidence: float
    """probability that `visible` is right; NaN where nothing measures it"""


@dataclass(frozen=True)
class Painter:
    """Makes masks of one recording."""

    clip: Clip
    world_from_camera: Float[np.ndarray, "frame 4 4"]
    balls: list[Sphere | None]
    judge: Judge
    height_px: int
    appearance: Palette | Appearance
    edges: Edges = field(default_factory=Edges)

    def masks(self, frames: Iterable[int]) -> Iterator[Mask]:
        """Make one mask per frame, in order, at colour resolution."""
        for frame in frames:
            mask = self.working_mask(frame)
            labels = mask.labels
            if labels.shape != self.clip.color_size:
                labels = cv2.resize(labels, self.clip.color_size[::-1], interpolation=cv2.INTER_NEAREST)
            yield replace(mask, labels=labels)

    def working_picture(self, frame: int) -> UInt8[np.ndarray, "height width 3"]:
        """Read a frame at working resolution."""
        return working_picture(self.clip, frame, self.height_px)

    def working_mask(self, frame: int) -> Mask:
        """Make one mask at working resolution."""
        empty = np.zeros(working_size(self.clip, self.height_px), np.uint8)
        ball = self.balls[frame]
        if ball is None:
            return Mask(empty, False, ABSENT_UNTRACKED)
        color = working_picture(self.clip, frame, self.height_px)
        window = cut(self.clip, frame, self.world_from_camera[frame], ball, color)
        if window is None:
            return Mask(empty, False, ABSENT_PRESUMED if ball.presumed else 1.0)
        evidence = self.judge(frame, window, ball)
        match self.appearance:
            case Palette() as palette:
                like = palette.ratio(window.color, evidence.room)
                log_odds = evidence.log_odds + COLOR_WEIGHT * like
                log_odds = refine.sharpen(log_odds, evidence.certainty, window.color, self.edges)
                sure = evidence.animal
                labels = refine.label(log_odds, sure, self.edges)
            case Appearance() as network:
                like = network.log_odds_within(color, window.rows, window.columns)
                labels, sure = self._by_appearance(window, evidence, like)
        inside = labels == 255
        if sure[inside].sum() < (MIN_PRESUMED_PX if ball.presumed else 1):
            return Mask(empty, False, ABSENT_PRESUMED if ball.presumed else ABSENT_TRACKED)
        present = self._presence(evidence, like, inside, ball.presumed)
        if present < 0:  # unknown rather than animal
            labels = np.where(labels == 255, 128, labels)
        empty[window.rows, window.columns] = labels
        offset, slope = FOUND_CALIBRATION if present >= 0 else MISSED_CALIBRATION
        confidence = 1 / (1 + np.exp(-min(offset + slope * abs(present), LOG_ODDS_LIMIT)))
        return Mask(empty, present >= 0, float(confidence))

    def _presence(
        self,
        evidence: Evidence,
        like: Float[np.ndarray, "height width"],
        inside: Bool[np.ndarray, "height width"],
        presumed: bool,
    ) -> float:
        """Return the log-odds that a mask shows the animal: by appearance, motion and track."""
        similarity = float(np.clip(like[inside], -PRESENCE_LIMIT, PRESENCE_LIMIT).mean())
        moved = float(evidence.clear[inside].mean())
        return (
            PRESENCE_PRESUMED
            + PRESENCE_TRACKED * (not presumed)
            + PRESENCE_APPEARANCE * similarity
            + PRESENCE_MOVED * moved
        )

    def _by_appearance(
        self, window: Window, evidence: Evidence, like: Float[np.ndarray, "height width"]
    ) -> tuple[UInt8[np.ndarray, "height width"], Bool[np.ndarray, "height width"]]:
        """Return labels and what is sure, by evidence and the learned appearance: that a surface has another
        colour counts as far as it looks like the animal.

        A small mask must be well backed, since chance makes small ones; and as a small view lies at steps of
        depth all over, what moves clearly there is sure too if no mask is found without it.
        """
        gloss = evidence.recolored / (1 + np.exp(like))
        known = refine.sharpen(evidence.log_odds - gloss, evidence.certainty, window.color, self.edges)
        blind = evidence.certainty < UNKNOWN
        weight = np.where(blind, APPEARANCE_WEIGHT_BLIND, APPEARANCE_WEIGHT)
        most = np.where(blind, APPEARANCE_ALONE, 0.0)
        log_odds = known + np.clip(weight * like, -APPEARANCE_AGAINST, most) - DOUBT
        strict = (log_odds > SURE) & (evidence.animal | (like > 0))
        for sure, enough_px in ((strict, SMALL_PX), (strict | ((log_odds > SURE) & evidence.clear), np.inf)):
            labels = refine.without_strays(refine.label(log_odds, sure, self.edges), like)
            inside = labels == 255
            if inside.sum() >= enough_px or (
                inside.any() and ((like > 0) | evidence.clear)[inside].mean() >= BACKED
            ):
                return labels, sure
        return np.zeros_like(labels), sure


def learn_palette(painter: Painter, pictures: int = 30) -> Palette:
    """Learn the animal's colours from frames spread over the recording."""
    palette = Palette()
    seen = [
        (frame, ball) for frame, ball in enumerate(painter.balls) if ball is not None and not ball.presumed
    ]
    for frame, ball in seen[:: max(1, len(seen) // pictures)]:
        color = working_picture(painter.clip, frame, painter.height_px)
        window = cut(painter.clip, frame, painter.world_from_camera[frame], ball, color)
        if window is not None:
            sure = painter.judge(frame, window, ball).animal.astype(np.uint8)
            palette.learn(window.color[cv2.erode(sure, np.ones((3, 3), np.uint8)) > 0])
    return palette
