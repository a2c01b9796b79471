"""Grounding DINO detects the animal from a text prompt in some frames; SAM 2 tracks the best detection.

A user's box or click replaces the detector. Masks are generated lazily; those before the first frame are
stored compressed, so that memory hardly grows with the recording.
"""

from collections.abc import Iterator

import cv2
import numpy as np
from jaxtyping import Float

from pipeline.backends.grounding_dino import GroundingDino
from pipeline.backends.sam2 import Sam2
from pipeline.core.errors import InputError
from pipeline.data.clips import Clip
from pipeline.geometry import subsampling
from stages.segment_agent.config import FoundationConfig
from stages.segment_agent.prompts import Prompt
from stages.segment_agent.segmenter import Mask

LOOKED_AT = 16
"""number of frames given to the detector"""
UNSURE = 1.0
"""pixels with log-odds below this magnitude are unknown"""


def segment(clip: Clip, prompt: Prompt | None, options: FoundationConfig, device: str) -> Iterator[Mask]:
    """Yield one mask per frame. Raises MSK-004 if the animal is not found, MOD-001..003 without models."""
    tracker = Sam2(options.tracker, device)
    if prompt is None:
        frame, box_px = _find(clip, GroundingDino(options.detector, device), options)
    else:
        frame, box_px = prompt.frame, widened(prompt, clip.color_size)
    return _follow(clip, tracker, frame, box_px)


def _find(
    clip: Clip, detector: GroundingDino, options: FoundationConfig
) -> tuple[int, Float[np.ndarray, "4"]]:
    """Return the frame and box (x0, y0, x1, y1, pixels) of the detection with the highest score."""
    best: tuple[float, int, np.ndarray] | None = None
    for frame in subsampling.evenly(len(clip), LOOKED_AT, rounded=True).tolist():
        boxes_px, score = detector.find(clip.color(frame), options.description, options.threshold)
        if len(score) and (best is None or score[0] > best[0]):
            best = (float(score[0]), frame, boxes_px[0])
    if best is None:
        what = f"{options.description!r} was found in none of {LOOKED_AT} frames"
        remedy = "describe the animal otherwise, or point at it with a prompt"
        raise InputError("MSK-004", what, str(clip.folder), remedy)
    return best[1], best[2]


def widened(prompt: Prompt, size: tuple[int, int], least: float = 0.04) -> Float[np.ndarray, "4"]:
    """Return the box of a prompt (x0, y0, x1, y1, pixels), enlarged to a minimum size around a click."""
    x0, y0, x1, y1 = prompt.box_px
    grow = np.maximum(least * max(size) - np.array([x1 - x0, y1 - y0]), 0) / 2
    low, high = np.array([x0, y0]) - grow, np.array([x1, y1]) + grow
    return np.concatenate([np.maximum(low, 0), np.minimum(high, size[::-1])])


def _follow(clip: Clip, tracker: Sam2, start: int, box_px: Float[np.ndarray, "4"]) -> Iterator[Mask]:
    before: list[tuple[bytes, bool, float]] = []
    for log_odds, presence in tracker.track(clip.color, range(start, -1, -1), box_px):
        mask = labeled(log_odds, presence, UNSURE)
        before.append((cv2.imencode(".png", mask.labels)[1].tobytes(), mask.visible, mask.confidence))
    while len(before) > 1:
        png, visible, confidence = before.pop()
        labels = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_UNCHANGED)
        assert labels is not None, "a PNG of our own"
        yield Mask(labels, visible, confidence)
    for log_odds, presence in tracker.track(clip.color, range(start, len(clip)), box_px):
        yield labeled(log_odds, presence, UNSURE)


def labeled(log_odds: Float[np.ndarray, "height width"], presence: float, unsure: float) -> Mask:
    """Turn log-odds into 255 agent, 0 not, 128 unknown; an empty mask where presence has log-odds <= 0."""
    labels = np.where(log_odds > unsure, 255, np.where(log_odds < -unsure, 0, 128)).astype(np.uint8)
    inside = labels == 255
    if presence <= 0 or not inside.any():
        return Mask(np.zeros(labels.shape, np.uint8), False, float(1 / (1 + np.exp(presence))))
    return Mask(labels, True, float((1 / (1 + np.exp(-log_odds[inside]))).mean()))
