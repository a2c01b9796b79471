"""Masks of a recording without depth, from one box: color and flow only.

GrabCut segments the prompted frame, initialized with what moves against the background if enough does.
`propagation` then propagates this mask through the recording. Near the outlines, GrabCut decides again.
"""

from collections.abc import Iterator

import cv2
import numpy as np

from pipeline.segmentation.config import LearningConfig
from pipeline.segmentation.grabcut import grabcut, sharpened
from stages.segment_agent.footage import MOVING, STILL, Footage
from stages.segment_agent.prompts import Prompt
from stages.segment_agent.propagation import CERTAIN, MAX_LOG_ODDS, LogOdds, propagate
from stages.segment_agent.segmenter import Mask

HEIGHT_PX = 240
"""picture height for propagation: flow is no finer"""
CLICK_REACH = 0.2
"""half size of the box around a click, as a share of the picture's height"""
MOTION_GAPS, MIN_MOVING = (4, 8), 0.15
"""frame gaps over which motion is measured in the prompted frame, and share of the box that must move for it
to be used"""


def follow(
    footage: Footage, prompt: Prompt, learning: LearningConfig, rng: np.random.Generator
) -> Iterator[Mask]:
    """Yield one mask per frame at color resolution."""
    coarse = Footage(footage.clip, footage.flow, min(HEIGHT_PX, footage.height_px))
    first = segment_prompt(footage, prompt, rng)
    first = cv2.resize(first, coarse.size[::-1], interpolation=cv2.INTER_AREA)
    for frame, log_odds in enumerate(propagate(coarse, prompt.frame, first, learning, rng)):
        inside = cv2.resize(log_odds, footage.size[::-1], interpolation=cv2.INTER_LINEAR) > 0
        sharp = sharpened(footage.color(frame), inside, rng).astype(np.float32)
        inside = cv2.resize(sharp, footage.clip.color_size[::-1], interpolation=cv2.INTER_LINEAR) > 1 / 2
        yield Mask(np.where(inside, 255, 0).astype(np.uint8), bool(inside.any()), np.nan)


def segment_prompt(footage: Footage, prompt: Prompt, rng: np.random.Generator) -> LogOdds:
    """Segment the animal in the prompt's box, or in one around a click: log-odds, -`MAX_LOG_ODDS` outside."""
    color = footage.color(prompt.frame)
    height, width = color.shape[:2]
    x0, y0, x1, y1 = np.array(prompt.box_px) * height / footage.clip.color_size[0]
    if min(x1 - x0, y1 - y0) < 4:
        x0, y0, x1, y1 = np.array([x0, y0, x1, y1]) + CLICK_REACH * height * np.array([-1, -1, 1, 1])
    low = np.clip(np.floor([x0, y0]), 1, [width - 8, height - 8]).astype(int)
    high = np.minimum(np.ceil([x1, y1]).astype(int), [width - 1, height - 1])
    in_box = np.zeros((height, width), bool)
    in_box[low[1] : high[1], low[0] : high[0]] = True
    residual = footage.residual(prompt.frame, *MOTION_GAPS)
    still = (residual < STILL) & ((residual[in_box] > MOVING).mean() > MIN_MOVING)
    trimap = np.where(in_box, np.where(still, cv2.GC_PR_BGD, cv2.GC_PR_FGD), cv2.GC_BGD).astype(np.uint8)
    inside = grabcut(color, trimap, rng)
    inside = inside if inside.any() else in_box
    log_odds = np.where(in_box, -(CERTAIN + MAX_LOG_ODDS) / 2, -MAX_LOG_ODDS)
    return np.where(inside, MAX_LOG_ODDS, log_odds).astype(np.float32)
