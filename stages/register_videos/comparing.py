"""A recorded picture beside the template as it looks from there, so that the two can be compared."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from pipeline.files.clips import Clip, Masks
from pipeline.space import cameras
from pipeline.space.meshes import RayCaster, render_view


@dataclass(frozen=True)
class Comparison:
    """One frame at half the size of its picture."""

    intrinsics: Float[np.ndarray, "3 3"]
    depth: Float[np.ndarray, "height width"]
    """of the template, metres, 0 where there is none"""
    rendered: Float[np.ndarray, "height width 3"]
    recorded: UInt8[np.ndarray, "height width 3"]
    known: Bool[np.ndarray, "height width"]
    """where there is template and surely no animal"""


def compare(clip: Clip, masks: Masks, caster: RayCaster, frame: int, world_from_camera: Float[np.ndarray, "4 4"]) -> Comparison:
    """Render the template from where a frame was taken."""
    size = (clip.color_size[0] // 2, clip.color_size[1] // 2)
    intrinsics = cameras.scale_intrinsics(clip.intrinsics[frame], clip.color_size, size)
    depth, hits = render_view(caster, world_from_camera, intrinsics, *size)
    rendered = hits.interpolate(caster.mesh, caster.mesh.color).reshape(*size, 3)
    recorded = cv2.resize(clip.color(frame), size[::-1], interpolation=cv2.INTER_AREA)
    free = cv2.resize((masks[frame] == 0).astype(np.uint8), size[::-1], interpolation=cv2.INTER_NEAREST) > 0
    return Comparison(intrinsics, depth, rendered, recorded, (depth > 0) & free)
