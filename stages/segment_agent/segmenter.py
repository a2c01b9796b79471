"""One sharp mask per frame, from the tracked sphere, evidence and the animal's appearance."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from pipeline.data.clips import Clip
from pipeline.segmentation.appearance import Appearance, strongest
from pipeline.segmentation.grabcut import SURE, LogOdds, outlined
from stages.segment_agent import refine
from stages.segment_agent.evidence import Evidence, EvidenceOf
from stages.segment_agent.refine import ColorHistogram, Edges
from stages.segment_agent.windows import Sphere, Window, crop_window, working_picture, working_size

COLOR_WEIGHT, COLOR_FRAMES = 0.7, 30
"""weight of the colors' log-likelihood ratio; frames from which colors are learned"""
APPEARANCE_WEIGHT, APPEARANCE_WEIGHT_BLIND = 0.3, 0.6
"""weight of the appearance's log-odds where geometry is known, and where it is not"""
APPEARANCE_ALONE, APPEARANCE_AGAINST = 3.0, 4.0
"""limit of the appearance's log-odds for the animal where geometry is unknown (0 elsewhere, since geometric
edges are sharper), and against it anywhere"""
DOUBT = 0.2
"""prior log-odds of background with an appearance that was learned from first masks, which leak"""
SMALL_PX, MIN_SUPPORT = 250, 0.7
"""masks smaller than this many pixels need this share that looks like the animal or clearly moves"""
MIN_PRESUMED_PX = 25
"""sure pixels required where the sphere is presumed"""
PRESENCE_PRESUMED, PRESENCE_TRACKED, PRESENCE_MOVED, PRESENCE_LIMIT = -2.5, 2.0, 3.0, 4.0
"""log-odds that a mask shows the animal: base value; added if tracked rather than presumed, and if all of it
clearly moves; limit of its mean appearance, which is added too"""
PRESENCE_THROUGH = 2.0
"""log-odds that are added if all of a mask is seen through in spite of drift, too"""
ABSENT_PRESUMED, ABSENT_TRACKED, ABSENT_UNTRACKED = 0.88, 0.04, 0.99
"""probability that less than 0.1 % of the view is animal if no mask is found: at a presumed sphere (456 of
518), on the track (0 of 22), else (183 of 183); two semi-real kitchens, six of a cat; add-one smoothing"""
LOG_ODDS_LIMIT = 5.0
"""limit of the log-odds of confidence"""
FOUND_CALIBRATION, MISSED_CALIBRATION = (0.5, 2.5), (-1.0, 0.7)
"""offset and slope of the Platt scaling of presence, fitted on semi-real sequences: an accepted mask is
hardly ever wrong, while an animal just entering the view is often missed"""
UNKNOWN = 0.3
"""certainty below which geometry is unknown"""


@dataclass(frozen=True)
class Mask:
    """One frame's result at color resolution."""

    labels: UInt8[np.ndarray, "height width"]
    visible: bool
    confidence: float
    """probability that `visible` is right; NaN if not estimated"""


@dataclass(frozen=True)
class Segmenter:
    """Segments the frames of one recording."""

    clip: Clip
    world_from_camera: Float[np.ndarray, "frame 4 4"]
    spheres: list[Sphere | None]
    evidence_of: EvidenceOf
    height_px: int
    appearance: ColorHistogram | Appearance = field(default_factory=ColorHistogram)
    edges: Edges = field(default_factory=Edges)
    outline_rng: np.random.Generator | None = None
    """if given, only the component with the most evidence is the animal, and GrabCut decides again near its
    outline; what both disagree about is unknown"""

    def masks(self, frames: Iterable[int]) -> Iterator[Mask]:
        """Make one mask per frame, in order, at color resolution."""
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
        sphere = self.spheres[frame]
        if sphere is None:
            return Mask(empty, False, ABSENT_UNTRACKED)
        color = self.working_picture(frame)
        window = crop_window(self.clip, frame, self.world_from_camera[frame], sphere, color)
        if window is None:
            return Mask(empty, False, ABSENT_PRESUMED if sphere.presumed else 1.0)
        evidence, recognized = self.evidence_of(frame, window, sphere), self.outline_rng is not None
        match self.appearance:
            case ColorHistogram() as histogram:
                log_ratio = histogram.log_likelihood_ratio(window.color, evidence.room)
                log_odds = evidence.log_odds + COLOR_WEIGHT * log_ratio
                log_odds = refine.sharpen(log_odds, evidence.certainty, window.color, self.edges)
                sure = evidence.animal
                labels = refine.label(log_odds, sure, self.edges)
            case Appearance() as network:
                log_ratio = network.log_odds_within(color, window.rows, window.columns)
                # A small animal looks less like itself; where it is tracked, what looks like it is it.
                doubts = (SURE if sphere.presumed else DOUBT, 0.0) if recognized else (SURE, DOUBT)
                labels, sure = self._by_appearance(window, evidence, log_ratio, *doubts)
        if self.outline_rng is not None:
            part = strongest(labels == 255, log_ratio)
            sharp = outlined(window.color, part, log_ratio, self.outline_rng)
            labels = np.where((sharp != part) | ((labels == 255) & ~part), np.uint8(128), labels)
        inside = labels == 255
        if sure[inside].sum() < (MIN_PRESUMED_PX if sphere.presumed else 1):
            return Mask(empty, False, ABSENT_PRESUMED if sphere.presumed else ABSENT_TRACKED)
        core = inside & (log_ratio > DOUBT / APPEARANCE_WEIGHT_BLIND) if recognized else inside  # no outline
        present = self._presence(evidence, log_ratio, core, sphere.presumed)
        if present < 0:  # unknown rather than animal
            labels = np.where(labels == 255, 128, labels)
        empty[window.rows, window.columns] = labels
        offset, slope = FOUND_CALIBRATION if present >= 0 else MISSED_CALIBRATION
        confidence = 1 / (1 + np.exp(-min(offset + slope * abs(present), LOG_ODDS_LIMIT)))
        return Mask(empty, present >= 0, float(confidence))

    def _presence(
        self,
        evidence: Evidence,
        log_ratio: Float[np.ndarray, "height width"],
        inside: Bool[np.ndarray, "height width"],
        presumed: bool,
    ) -> float:
        """Return the log-odds that a mask shows the animal: by appearance, motion and track."""
        similarity = float(np.clip(log_ratio[inside], -PRESENCE_LIMIT, PRESENCE_LIMIT).mean())
        moved, through = (float(part[inside].mean()) for part in (evidence.moving, evidence.seen_through))
        motion = PRESENCE_MOVED * moved + PRESENCE_THROUGH * through
        return PRESENCE_PRESUMED + PRESENCE_TRACKED * (not presumed) + similarity + motion

    def _by_appearance(
        self, window: Window, evidence: Evidence, log_ratio: LogOdds, sure_at: float, doubt: float = DOUBT
    ) -> tuple[UInt8[np.ndarray, "height width"], Bool[np.ndarray, "height width"]]:
        """Return labels and sure pixels, above ``sure_at``, by evidence and appearance, less ``doubt``.

        Color change counts as far as it looks like the animal. Small masks need support, since noise makes
        them too. If none is found, clearly moving pixels are sure: small views are all depth steps.
        """
        gloss = evidence.color_log_odds / (1 + np.exp(log_ratio))
        known = refine.sharpen(evidence.log_odds - gloss, evidence.certainty, window.color, self.edges)
        blind = evidence.certainty < UNKNOWN
        weight = np.where(blind, APPEARANCE_WEIGHT_BLIND, APPEARANCE_WEIGHT)
        most = np.where(blind, APPEARANCE_ALONE, 0.0)
        log_odds = known + np.clip(weight * log_ratio, -APPEARANCE_AGAINST, most) - doubt
        strict = (log_odds > sure_at) & (evidence.animal | (log_ratio > 0))
        relaxed = strict | ((log_odds > SURE) & evidence.moving)
        for sure, enough_px in ((strict, SMALL_PX), (relaxed, np.inf)):
            labels = refine.label(log_odds, sure, self.edges)
            labels = refine.remove_strays(labels, log_ratio, evidence.seen_through)
            inside = labels == 255
            if inside.sum() >= enough_px or (
                inside.any() and ((log_ratio > 0) | evidence.moving)[inside].mean() >= MIN_SUPPORT
            ):
                return labels, sure
        return np.zeros_like(labels), sure


def with_color_histogram(segmenter: Segmenter) -> Segmenter:
    """Return the segmenter with the animal's colors, learned from frames spread over the recording."""
    histogram = ColorHistogram()
    seen = [(frame, each) for frame, each in enumerate(segmenter.spheres) if each and not each.presumed]
    for frame, sphere in seen[:: max(1, len(seen) // COLOR_FRAMES)]:
        color = segmenter.working_picture(frame)
        window = crop_window(segmenter.clip, frame, segmenter.world_from_camera[frame], sphere, color)
        if window is not None:
            sure = segmenter.evidence_of(frame, window, sphere).animal.astype(np.uint8)
            histogram.learn(window.color[cv2.erode(sure, np.ones((3, 3), np.uint8)) > 0])
    return replace(segmenter, appearance=histogram)
