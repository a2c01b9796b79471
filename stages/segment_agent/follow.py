"""Masks of a recording without depth, from one box: color and flow only.

GrabCut segments the prompted frame, initialized with what moves against the background if enough does.
`propagation` then propagates this mask through the recording. Near the outlines, GrabCut decides again.
"""

from collections.abc import Iterator

import cv2
import numpy as np
from jaxtyping import UInt8

from stages.segment_agent.config import LearningConfig
from stages.segment_agent.footage import MOVING, STILL, Footage, Region, dilated
from stages.segment_agent.prompts import Prompt
from stages.segment_agent.propagation import CERTAIN, MAX_LOG_ODDS, LogOdds, propagate
from stages.segment_agent.segmenter import Mask

HEIGHT_PX = 240
"""picture height for propagation: flow is no finer"""
ITERATIONS, MODEL_SIZE = 8, 65
"""iterations of GrabCut; size of its models: five Gaussians with weight, mean and covariance"""
BAND, SHARPENING = 0.05, 2
"""half width of the band in which outlines are decided again, in roots of the area; iterations of GrabCut"""
CLICK_REACH = 0.2
"""half size of the box around a click, as a share of the picture's height"""
MOTION_GAPS, MIN_MOVING = (4, 8), 0.15
"""frame gaps over which motion is measured in the prompted frame, and share of the box that must move for it
to be used"""
Color = UInt8[np.ndarray, "height width 3"]
Trimap = UInt8[np.ndarray, "height width"]


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


def sharpened(color: Color, inside: Region, rng: np.random.Generator) -> Region:
    """Let GrabCut decide again near the outline of a mask: colors are finer than flow."""
    reach_px = max(1, round(BAND * float(np.sqrt(inside.sum()))))
    core, far = ~dilated(~inside, reach_px), ~dilated(inside, reach_px)
    if not (core.any() and far.any()):
        return inside
    probable = np.where(inside, cv2.GC_PR_FGD, cv2.GC_PR_BGD)
    trimap = np.where(core, cv2.GC_FGD, np.where(far, cv2.GC_BGD, probable)).astype(np.uint8)
    return grabcut(color, trimap, rng, SHARPENING)


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


def grabcut(color: Color, trimap: Trimap, rng: np.random.Generator, iterations: int = ITERATIONS) -> Region:
    """Segment a picture by GrabCut (Rother et al. 2004); ``trimap`` has OpenCV's four labels."""
    cv2.setRNGSeed(int(rng.integers(2**31 - 1)))
    models, by_mask = np.zeros((2, 1, MODEL_SIZE)), cv2.GC_INIT_WITH_MASK
    found = cv2.grabCut(color, trimap.copy(), (0, 0, 0, 0), models[0], models[1], iterations, by_mask)[0]
    return (found == cv2.GC_FGD) | (found == cv2.GC_PR_FGD)
