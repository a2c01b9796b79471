"""Masks of a recording without depth, from one box: color and flow only.

GrabCut cuts the animal out of the hinted frame, beginning with what moves there against the background if
much does. `propagation` carries this mask through the recording.
"""

from collections.abc import Iterator

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from stages.segment_agent.config import LearningConfig
from stages.segment_agent.footage import MOVING, STILL, Footage
from stages.segment_agent.painting import Mask
from stages.segment_agent.prompt import Prompt
from stages.segment_agent.propagation import CERTAIN, SURE, propagate

HEIGHT_PX = 240
"""of the pictures that the mask is carried through: flow is no finer"""
ROUNDS, MODEL_NUMBERS = 8, 65
"""of GrabCut; its models are five Gaussians of a weight, a mean and a covariance each"""
CLICK_REACH = 0.2
"""of the box around a click, as a share of the picture's height"""
MOTION_GAPS, MIN_MOVING = (4, 8), 0.15
"""frames over which motion is measured in the hinted frame, and share of the box that must move for motion to
separate the animal from the rest of the box"""


def follow(
    footage: Footage, hint: Prompt, learning: LearningConfig, rng: np.random.Generator
) -> Iterator[Mask]:
    """Return one mask per frame at color resolution."""
    coarse = Footage(footage.clip, footage.flow, min(HEIGHT_PX, footage.height_px))
    first = cut_out(footage, hint, rng)
    first = cv2.resize(first, coarse.size[::-1], interpolation=cv2.INTER_AREA)
    for log_odds in propagate(coarse, hint.frame, first, learning, rng):
        inside = cv2.resize(log_odds, footage.clip.color_size[::-1], interpolation=cv2.INTER_LINEAR) > 0
        yield Mask(np.where(inside, 255, 0).astype(np.uint8), bool(inside.any()), np.nan)


def cut_out(footage: Footage, hint: Prompt, rng: np.random.Generator) -> Float[np.ndarray, "height width"]:
    """Cut the animal out of the hinted frame, or of a box around a click: log-odds, -`SURE` outside."""
    color = footage.color(hint.frame)
    height, width = color.shape[:2]
    x0, y0, x1, y1 = np.array(hint.box_px) * height / footage.clip.color_size[0]
    if min(x1 - x0, y1 - y0) < 4:
        x0, y0, x1, y1 = np.array([x0, y0, x1, y1]) + CLICK_REACH * height * np.array([-1, -1, 1, 1])
    low = np.clip(np.floor([x0, y0]), 1, [width - 8, height - 8]).astype(int)
    high = np.minimum(np.ceil([x1, y1]).astype(int), [width - 1, height - 1])
    boxed = np.zeros((height, width), bool)
    boxed[low[1] : high[1], low[0] : high[0]] = True
    residual = footage.residual(hint.frame, *MOTION_GAPS)
    still = (residual < STILL) & ((residual[boxed] > MOVING).mean() > MIN_MOVING)
    marks = np.where(boxed, np.where(still, cv2.GC_PR_BGD, cv2.GC_PR_FGD), cv2.GC_BGD).astype(np.uint8)
    inside = grab(color, marks, rng)
    inside = inside if inside.any() else boxed
    return np.where(inside, SURE, np.where(boxed, -(CERTAIN + SURE) / 2, -SURE)).astype(np.float32)


def grab(
    color: UInt8[np.ndarray, "height width 3"],
    marks: UInt8[np.ndarray, "height width"],
    rng: np.random.Generator,
) -> Bool[np.ndarray, "height width"]:
    """Cut something out of a picture by GrabCut (Rother et al. 2004); ``marks`` are OpenCV's four."""
    cv2.setRNGSeed(int(rng.integers(2**31 - 1)))
    models, by_mask = np.zeros((2, 1, MODEL_NUMBERS)), cv2.GC_INIT_WITH_MASK
    found = cv2.grabCut(color, marks.copy(), (0, 0, 0, 0), models[0], models[1], ROUNDS, by_mask)[0]
    return (found == cv2.GC_FGD) | (found == cv2.GC_PR_FGD)
