"""Does the recording look like the template where both have the same shape? Flats of one house differ only in that."""

import cv2
import numpy as np
from jaxtyping import Float

from pipeline.files.clips import Clip, Masks
from pipeline.space import cameras
from pipeline.space.meshes import RayCaster, render_view
from stages.register_videos.alignment import even

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
    size = (clip.color_size[0] // 2, clip.color_size[1] // 2)
    intrinsics = cameras.scale_intrinsics(clip.intrinsics[frame], clip.color_size, size)
    rendered, hits = render_view(caster, world_from_camera, intrinsics, *size)
    color = hits.interpolate(caster.mesh, caster.mesh.color).reshape(*size, 3)
    real = cv2.resize(clip.color(frame), size[::-1], interpolation=cv2.INTER_AREA)
    free = cv2.resize((masks[frame] == 0).astype(np.uint8), size[::-1], interpolation=cv2.INTER_NEAREST) > 0
    depth = cv2.resize(clip.depth(frame), size[::-1], interpolation=cv2.INTER_NEAREST)
    known = (rendered > 0) & free
    same = known & (np.abs(depth - rendered) < FITS_M)
    if same.mean() < LEAST_SHARE:
        return np.nan
    pair = [cv2.GaussianBlur(even(picture, known).astype(np.float64), (0, 0), blur_px)[same] for picture in (color, real)]
    first, second = (values - values.mean() for values in pair)
    return float(first @ second / max(np.linalg.norm(first) * np.linalg.norm(second), 1e-9))
