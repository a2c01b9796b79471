"""GrabCut from labels, and near the outline of a mask."""

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

ITERATIONS, MODEL_SIZE = 8, 65
"""iterations of GrabCut; size of its models: five Gaussians with weight, mean and covariance"""
BAND, SHARPENING = 0.05, 2
"""half width of the band in which outlines are decided again, in roots of the area; iterations of GrabCut"""
SURE = 1.0
"""log-odds of a learned appearance above which a pixel is surely animal, though GrabCut may cut it off"""
Color = UInt8[np.ndarray, "height width 3"]
Trimap = UInt8[np.ndarray, "height width"]
Region = Bool[np.ndarray, "height width"]
LogOdds = Float[np.ndarray, "height width"]


def sharpened(color: Color, inside: Region, rng: np.random.Generator) -> Region:
    """Let GrabCut decide again near the outline of a mask: colors are finer than flow."""
    reach_px = max(1, round(BAND * float(np.sqrt(inside.sum()))))
    core, far = ~dilated(~inside, reach_px), ~dilated(inside, reach_px)
    if not (core.any() and far.any()):
        return inside
    probable = np.where(inside, cv2.GC_PR_FGD, cv2.GC_PR_BGD)
    trimap = np.where(core, cv2.GC_FGD, np.where(far, cv2.GC_BGD, probable)).astype(np.uint8)
    return grabcut(color, trimap, rng, SHARPENING)


def outlined(color: Color, animal: Region, log_odds: LogOdds, rng: np.random.Generator) -> Region:
    """Sharpen a recognized animal, but keep what surely is the animal."""
    return sharpened(color, animal, rng) | (animal & (log_odds > SURE))


def grabcut(color: Color, trimap: Trimap, rng: np.random.Generator, iterations: int = ITERATIONS) -> Region:
    """Segment a picture by GrabCut (Rother et al. 2004); ``trimap`` has OpenCV's four labels."""
    cv2.setRNGSeed(int(rng.integers(2**31 - 1)))
    models, by_mask = np.zeros((2, 1, MODEL_SIZE)), cv2.GC_INIT_WITH_MASK
    found = cv2.grabCut(color, trimap.copy(), (0, 0, 0, 0), models[0], models[1], iterations, by_mask)[0]
    return (found == cv2.GC_FGD) | (found == cv2.GC_PR_FGD)


def dilated(mask: Region, by_px: int) -> Region:
    """Dilate a mask by a disc."""
    disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * by_px + 1, 2 * by_px + 1))
    return cv2.dilate(mask.astype(np.uint8), disc) > 0
