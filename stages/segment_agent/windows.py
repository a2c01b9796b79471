"""Cut the part of a frame that may show the animal, at working resolution, with points in the world."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from pipeline.data.clips import Clip
from pipeline.geometry import cameras, rigid
from pipeline.geometry.flying_pixels import supported
from stages.segment_agent.free_space import steady_depth

STEP_M = 0.05
"""difference of neighbouring depths that is a step and not a slope"""
NEAREST_M = 0.2
"""distance at which a ball is drawn that the camera is in"""


@dataclass(frozen=True)
class Sphere:
    """Where the animal is at one time: a ball in the recording's world, metres."""

    centre_world: Float[np.ndarray, "3"]
    radius_m: float
    presumed: bool = False
    """guessed from earlier or later frames, or apart from what a hint holds"""


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


def around(mask: Bool[np.ndarray, "height width"], margin_px: int) -> tuple[slice, slice]:
    """Return the rows and columns of what a mask shows, and so many pixels around it."""
    rows, columns = (
        slice(max(int(at.min()) - margin_px, 0), int(at.max()) + margin_px) for at in np.nonzero(mask)
    )
    return rows, columns


def rectangle(
    clip: Clip,
    frame: int,
    world_from_camera: Float[np.ndarray, "4 4"],
    ball: Sphere,
    size: tuple[int, int],
    rim_px: int = 8,
) -> tuple[slice, slice]:
    """Return the rows and columns of a picture of (height, width) that show a ball, if any."""
    intrinsics = cameras.scale_intrinsics(clip.intrinsics[frame], clip.color_size, size)
    centre = rigid.apply(rigid.inverse(world_from_camera), ball.centre_world[None])[0]
    pixel, depth = cameras.project(centre, intrinsics)
    if depth < 0.1:
        return slice(0, 0), slice(0, 0)
    reach = intrinsics[[0, 1], [0, 1]] * ball.radius_m / max(depth - 0.5 * ball.radius_m, NEAREST_M) + rim_px
    low = np.clip(np.floor(pixel - reach), 0, size[::-1]).astype(int)
    high = np.clip(np.ceil(pixel + reach), 0, size[::-1]).astype(int)
    return slice(low[1], high[1]), slice(low[0], high[0])


def cut(
    clip: Clip,
    frame: int,
    world_from_camera: Float[np.ndarray, "4 4"],
    ball: Sphere,
    color: UInt8[np.ndarray, "height width 3"],
) -> Window | None:
    """Read the rectangle around a ball out of a working picture; None when it is out of view."""
    size = color.shape[:2]
    intrinsics = cameras.scale_intrinsics(clip.intrinsics[frame], clip.color_size, size)
    rows, columns = rectangle(clip, frame, world_from_camera, ball, size)
    if min(rows.stop - rows.start, columns.stop - columns.start) < 4:
        return None
    grid = cameras.pixel_grid(*size)[rows, columns]
    at = np.floor(grid * [clip.depth_size[1] / size[1], clip.depth_size[0] / size[0]]).astype(int)
    z = unblurred(clip.depth(frame))[at[..., 1], at[..., 0]]
    trusted = steady_depth(clip, frame)[at[..., 1], at[..., 0]] > 0
    points_camera = cameras.unproject(grid, intrinsics) * z[..., None]
    points = rigid.apply(world_from_camera, points_camera.reshape(-1, 3)).reshape(*z.shape, 3)
    points[z == 0] = np.nan
    return Window(rows, columns, np.ascontiguousarray(color[rows, columns]), points, trusted)


def supported_depth(clip: Clip, frame: int) -> Float[np.ndarray, "height width"]:
    """Read depth without blur at steps, with thin things that neighbours agree on (0 = unknown)."""
    depth = unblurred(clip.depth(frame))
    return np.where(supported(depth), depth, 0)


def unblurred(depth: Float[np.ndarray, "height width"]) -> Float[np.ndarray, "height width"]:
    """Give a depth between two surfaces to the nearer one of both: sensors blur steps, and what floats there
    is no animal.

    Toggle mapping (Kramer and Bruckner 1975) where the neighbours differ by more than a step; it leaves the
    step where it is.
    """
    around = np.ones((3, 3), np.uint8)
    low = cv2.erode(np.where(depth > 0, depth, np.inf).astype(np.float32), around)
    high = cv2.dilate(depth, around)
    snapped = np.where(depth - low < high - depth, low, high)
    return np.where((depth > 0) & (high - low > STEP_M), snapped, depth)
