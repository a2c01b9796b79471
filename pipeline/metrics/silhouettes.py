"""The silhouette of a placed animal against its mask."""

import cv2
import numpy as np
from jaxtyping import Float

from pipeline.data.clips import Clip, Masks
from pipeline.geometry.meshes import RayCaster, render_view

HIDDEN_M, MIN_ANIMAL = 0.05, 0.005
"""Depth nearer than the animal by this hides it, meters; least share of a compared frame that it covers."""


def silhouette_iou(
    clip: Clip, masks: Masks, caster: RayCaster, frame: int, agent_from_camera: Float[np.ndarray, "4 4"]
) -> float:
    """Return the silhouette's IoU with the mask where it is not hidden; NaN where the animal is too small."""
    depth = clip.depth(frame)
    labels = cv2.resize(masks[frame], depth.shape[::-1], interpolation=cv2.INTER_NEAREST)
    rendered, _ = render_view(caster, agent_from_camera, clip.depth_intrinsics[frame], *depth.shape)
    animal, known = labels == 255, (labels != 128) & (depth > 0)
    if animal.mean() < MIN_ANIMAL:
        return np.nan
    hidden = ~animal & (depth < rendered - HIDDEN_M)
    silhouette, animal = (rendered > 0) & ~hidden & known, animal & known
    return float((silhouette & animal).sum() / max((silhouette | animal).sum(), 1))
