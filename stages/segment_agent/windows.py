"""Cut the part of a frame that may show the animal, at working resolution, with its points in the recording's world."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from pipeline.files.clips import Clip
from pipeline.space import cameras, rigid
from stages.segment_agent.free_space import usable_depth


@dataclass(frozen=True)
class Sphere:
    """Where the animal is at one time: a ball in the recording's world, metres."""

    centre_world: Float[np.ndarray, "3"]
    radius_m: float
    presumed: bool = False
    """guessed from earlier or later frames"""


@dataclass(frozen=True)
class Window:
    """A rectangle of a frame at working resolution."""

    rows: slice
    columns: slice
    color: UInt8[np.ndarray, "height width 3"]
    points_world: Float[np.ndarray, "height width 3"]
    """NaN where depth is unknown"""
    trusted: Bool[np.ndarray, "height width"]
    """where depth is neither of low confidence nor at a step"""


def working_size(clip: Clip, height_px: int) -> tuple[int, int]:
    """Return (height, width) of the pictures that masks are made at: no larger than ``height_px`` high."""
    height, width = clip.color_size
    scale = min(1.0, height_px / height)
    return round(height * scale), round(width * scale)


def working_picture(clip: Clip, frame: int, height_px: int) -> UInt8[np.ndarray, "height width 3"]:
    """Read a frame's colours at working resolution."""
    color, size = clip.color(frame), working_size(clip, height_px)
    return color if size == clip.color_size else cv2.resize(color, size[::-1], interpolation=cv2.INTER_AREA)


def cut(
    clip: Clip, frame: int, world_from_camera: Float[np.ndarray, "4 4"], ball: Sphere, color: UInt8[np.ndarray, "height width 3"]
) -> Window | None:
    """Read the rectangle around a ball with a rim of 8 px out of a working picture; None when it is out of view."""
    size = color.shape[:2]
    intrinsics = cameras.scale_intrinsics(clip.intrinsics[frame], clip.color_size, size)
    centre = rigid.apply(rigid.inverse(world_from_camera), ball.centre_world[None])[0]
    pixel, depth = cameras.project(centre, intrinsics)
    if depth < 0.1:
        return None
    reach = intrinsics[[0, 1], [0, 1]] * ball.radius_m / max(depth - 0.5 * ball.radius_m, 0.2) + 8
    low = np.clip(np.floor(pixel - reach), 0, [size[1], size[0]]).astype(int)
    high = np.clip(np.ceil(pixel + reach), 0, [size[1], size[0]]).astype(int)
    if (high - low).min() < 4:
        return None
    rows, columns = slice(low[1], high[1]), slice(low[0], high[0])
    grid = cameras.pixel_grid(*size)[rows, columns]
    at = np.floor(grid * [clip.depth_size[1] / size[1], clip.depth_size[0] / size[0]]).astype(int)
    z = clip.depth(frame)[at[..., 1], at[..., 0]]
    trusted = usable_depth(clip, frame)[at[..., 1], at[..., 0]] > 0
    points = rigid.apply(world_from_camera, (cameras.unproject(grid, intrinsics) * z[..., None]).reshape(-1, 3)).reshape(*z.shape, 3)
    points[z == 0] = np.nan
    return Window(rows, columns, np.ascontiguousarray(color[rows, columns]), points, trusted)
