"""Crop the part of a frame that may show the animal, at working resolution, with world points."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from pipeline.data.clips import Clip, usable_depth
from pipeline.geometry import cameras, rigid

STEP_M = 0.05
"""difference of neighboring depths above which they form a step"""
NEAREST_M = 0.2
"""least distance for the projected size of a sphere"""
RIM_PX = 8
"""margin around a sphere's bounding box"""


@dataclass(frozen=True)
class Sphere:
    """Bounding sphere of the animal at one time, in the recording's world, meters."""

    center_world: Float[np.ndarray, "3"]
    radius_m: float
    presumed: bool = False
    """interpolated or extrapolated in time, or not connected to the prompt"""


def tracked(spheres: Sequence[Sphere | None]) -> Bool[np.ndarray, "frame"]:
    """Return the frames with a tracked, not presumed, sphere."""
    return np.array([sphere is not None and not sphere.presumed for sphere in spheres])


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
    """Return the working (height, width): at most ``height_px`` high."""
    height, width = clip.color_size
    scale = min(1.0, height_px / height)
    return round(height * scale), round(width * scale)


def working_picture(clip: Clip, frame: int, height_px: int) -> UInt8[np.ndarray, "height width 3"]:
    """Read a frame's colors at working resolution."""
    color, size = clip.color(frame), working_size(clip, height_px)
    return color if size == clip.color_size else cv2.resize(color, size[::-1], interpolation=cv2.INTER_AREA)


def project_sphere(
    clip: Clip, frame: int, world_from_camera: Float[np.ndarray, "4 4"], sphere: Sphere, size: tuple[int, int]
) -> tuple[slice, slice]:
    """Return the rows and columns of a sphere's bounding box with a margin, in a picture of ``size``."""
    intrinsics = cameras.scale_intrinsics(clip.intrinsics[frame], clip.color_size, size)
    center = rigid.apply(rigid.inverse(world_from_camera), sphere.center_world[None])[0]
    pixel, depth = cameras.project(center, intrinsics)
    if depth < 0.1:
        return slice(0, 0), slice(0, 0)
    focal_px, radius_m = intrinsics[[0, 1], [0, 1]], sphere.radius_m
    reach = focal_px * radius_m / max(depth - 0.5 * radius_m, NEAREST_M) + RIM_PX
    low = np.clip(np.floor(pixel - reach), 0, size[::-1]).astype(int)
    high = np.clip(np.ceil(pixel + reach), 0, size[::-1]).astype(int)
    return slice(low[1], high[1]), slice(low[0], high[0])


def crop_window(
    clip: Clip,
    frame: int,
    world_from_camera: Float[np.ndarray, "4 4"],
    sphere: Sphere,
    color: UInt8[np.ndarray, "height width 3"],
) -> Window | None:
    """Crop a working picture to the bounding box of a sphere; None if it is out of view."""
    size = color.shape[:2]
    intrinsics = cameras.scale_intrinsics(clip.intrinsics[frame], clip.color_size, size)
    rows, columns = project_sphere(clip, frame, world_from_camera, sphere, size)
    if min(rows.stop - rows.start, columns.stop - columns.start) < 4:
        return None
    grid = cameras.pixel_grid(*size)[rows, columns]
    at = grid * np.divide(clip.depth_size, size)[::-1]
    z = cameras.sample_nearest(snap_depth_steps(clip.depth(frame)), at)
    trusted = cameras.sample_nearest(usable_depth(clip, frame, keep_steps=False), at) > 0
    points_camera = cameras.unproject(grid, intrinsics) * z[..., None]
    points = rigid.apply(world_from_camera, points_camera.reshape(-1, 3)).reshape(*z.shape, 3)
    points[z == 0] = np.nan
    return Window(rows, columns, np.ascontiguousarray(color[rows, columns]), points, trusted)


def snap_depth_steps(depth: Float[np.ndarray, "height width"]) -> Float[np.ndarray, "height width"]:
    """Snap depth between two surfaces to the closer of them, since sensors blur depth steps.

    Toggle mapping (Kramer and Bruckner 1975) where neighbors differ by more than a step.
    """
    around = np.ones((3, 3), np.uint8)
    low = cv2.erode(np.where(depth > 0, depth, np.inf).astype(np.float32), around)
    high = cv2.dilate(depth, around)
    snapped = np.where(depth - low < high - depth, low, high)
    return np.where((depth > 0) & (high - low > STEP_M), snapped, depth)
