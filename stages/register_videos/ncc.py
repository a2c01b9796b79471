"""Normalized cross-correlation of frames and renderings, where both have the same shape: flats differ only in
looks."""

import cv2
import numpy as np
from jaxtyping import Float

from pipeline.data.clips import Clip, Masks
from pipeline.geometry.meshes import RayCaster
from stages.register_videos.comparison import compare, local_contrast_normalization

FITS_M = 0.05
"""Pixels are compared where depth and rendering agree within this, metres."""
LEAST_SHARE = 0.1
"""Frames with fewer comparable pixels have no score."""
BLUR_PX = 1.5
"""Blur before the comparison, half-size pixels: the template's colours are that soft."""
LEAST_NORM = 1e-9


def ncc(
    clip: Clip, masks: Masks, caster: RayCaster, frame: int, world_from_camera: Float[np.ndarray, "4 4"]
) -> float:
    """Return the normalized cross-correlation, -1..1, of one frame with its rendering; NaN where too little
    is comparable."""
    pair = compare(clip, masks, caster, frame, world_from_camera)
    depth = cv2.resize(clip.depth(frame), pair.depth.shape[::-1], interpolation=cv2.INTER_NEAREST)
    same = pair.known & (np.abs(depth - pair.depth) < FITS_M)
    if same.mean() < LEAST_SHARE:
        return np.nan
    normalized = [
        local_contrast_normalization(picture, pair.known).astype(np.float64)
        for picture in (pair.rendered, pair.recorded)
    ]
    first, second = (cv2.GaussianBlur(each, (0, 0), BLUR_PX)[same] for each in normalized)
    first, second = first - first.mean(), second - second.mean()
    return float(first @ second / max(np.linalg.norm(first) * np.linalg.norm(second), LEAST_NORM))
