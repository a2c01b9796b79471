"""Does the recording look like the template where both have the same shape? Flats of one house differ only in that."""

import cv2
import numpy as np
from jaxtyping import Float

from pipeline.files.clips import Clip, Masks
from pipeline.space.meshes import RayCaster
from stages.register_videos.alignment import even
from stages.register_videos.comparing import compare

FITS_M = 0.05
"""Pixels are compared where depth and rendering agree within this."""
LEAST_SHARE = 0.1
"""Frames with fewer comparable pixels do not count."""


def likeness(
    clip: Clip, masks: Masks, caster: RayCaster, frame: int, world_from_camera: Float[np.ndarray, "4 4"], blur_px: float = 1.5
) -> float:
    """Return the correlation, -1..1, of one frame with its rendering, free of light: 1 is the same; NaN where too little can
    be compared.
    """
    seen = compare(clip, masks, caster, frame, world_from_camera)
    depth = cv2.resize(clip.depth(frame), seen.depth.shape[::-1], interpolation=cv2.INTER_NEAREST)
    same = seen.known & (np.abs(depth - seen.depth) < FITS_M)
    if same.mean() < LEAST_SHARE:
        return np.nan
    even_pair = [even(picture, seen.known).astype(np.float64) for picture in (seen.rendered, seen.recorded)]
    first, second = (values - values.mean() for values in (cv2.GaussianBlur(each, (0, 0), blur_px)[same] for each in even_pair))
    return float(first @ second / max(np.linalg.norm(first) * np.linalg.norm(second), 1e-9))
