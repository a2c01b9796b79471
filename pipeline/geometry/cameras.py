"""Pinhole cameras in OpenCV axes: x right, y down, z forward; pixel centers at +0.5; depth is z.

This file owns the pixel-center rule, the OpenGL flip and the quarter turns. Projection works on NumPy arrays
and on torch tensors alike, lookups in images on NumPy arrays.
"""

from typing import TYPE_CHECKING, Any, TypeVar

import cv2
import numpy as np
from jaxtyping import Float, Int, Num, Shaped

if TYPE_CHECKING:
    from torch import Tensor

Array = TypeVar("Array", np.ndarray, "Tensor")
"""Functions on pixels and points take NumPy arrays or torch tensors, and return the same."""

OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def pixel_grid(height: int, width: int) -> Float[np.ndarray, "height width 2"]:
    """Return the pixel centers (x, y) of an image."""
    return pixel_centers(*np.indices((height, width)))


def pixel_centers(
    row: Int[np.ndarray, "*batch"], column: Int[np.ndarray, "*batch"]
) -> Float[np.ndarray, "*batch 2"]:
    """Return the centers (x, y) of pixels given by row and column."""
    return np.stack([column, row], axis=-1) + 0.5


def pixel_index(
    pixel: Float[np.ndarray, "*batch 2"],
) -> tuple[Int[np.ndarray, "*batch"], Int[np.ndarray, "*batch"]]:
    """Return row and column of the pixels that contain finite positions (x, y), also beyond an image."""
    column, row = np.moveaxis(np.floor(pixel).astype(int), -1, 0)
    return row, column


def ray_directions(
    intrinsics: Float[np.ndarray, "3 3"], height: int, width: int
) -> Float[np.ndarray, "height width 3"]:
    """Return one ray per pixel in camera axes with z = 1, so that the distance along it is the depth."""
    return unproject(pixel_grid(height, width), intrinsics)


def unproject(pixel: Array, intrinsics: Array) -> Array:
    """Return rays ``[... 3]`` with z = 1 through pixels ``[... 2]``; intrinsics ``[... 3 3]``, same batch."""
    x = (pixel[..., 0] - intrinsics[..., 0, 2]) / intrinsics[..., 0, 0]
    y = (pixel[..., 1] - intrinsics[..., 1, 2]) / intrinsics[..., 1, 1]
    return _stack([x, y, x * 0 + 1])


def back_project(
    depth: Float[np.ndarray, "height width"], intrinsics: Float[np.ndarray, "3 3"]
) -> Float[np.ndarray, "height width 3"]:
    """Lift a depth image to points in camera axes; unknown depth 0 gives the camera's center."""
    return ray_directions(intrinsics, *depth.shape) * depth[..., None]


def project(points_camera: Array, intrinsics: Array) -> tuple[Array, Array]:
    """Project points ``[... 3]`` to pixels ``[... 2]`` and depth ``[...]``; depth <= 0 lies behind the camera
    and its pixel is meaningless."""
    z = points_camera[..., 2]
    safe = z + (abs(z) < 1e-9) * 1e-9
    x = points_camera[..., 0] / safe * intrinsics[..., 0, 0] + intrinsics[..., 0, 2]
    y = points_camera[..., 1] / safe * intrinsics[..., 1, 1] + intrinsics[..., 1, 2]
    return _stack([x, y]), z


def in_picture(pixel: Array, z: Array, size: tuple[int, int], nearest_m: float = 0.0) -> Array:
    """Return which points of `project` lie in a picture of (height, width) and farther than ``nearest_m``."""
    x, y = pixel[..., 0], pixel[..., 1]
    return (z > nearest_m) & (x >= 0) & (y >= 0) & (x < size[1]) & (y < size[0])


def sample_nearest(
    image: Shaped[np.ndarray, "height width"], pixel: Float[np.ndarray, "*batch 2"]
) -> Shaped[np.ndarray, "*batch"]:
    """Return the values of an image at pixels (x, y) by nearest-neighbor lookup; 0 outside."""
    inside = in_picture(pixel, np.ones(pixel.shape[:-1]), image.shape)
    values = image[pixel_index(np.where(inside[..., None], pixel, 0))]
    return np.where(inside, values, image.dtype.type(0))


def sample_bilinear(
    image: Num[np.ndarray, "height width *channel"], pixel: Float[np.ndarray, "rows columns 2"]
) -> Num[np.ndarray, "rows columns *channel"]:
    """Return the values of an image at pixels (x, y) by bilinear interpolation; 0 outside."""
    x, y = np.moveaxis((pixel - 0.5).astype(np.float32), -1, 0)
    return cv2.remap(np.ascontiguousarray(image), x, y, cv2.INTER_LINEAR)


def lookup_depth(
    depth: Float[np.ndarray, "height width"],
    intrinsics: Float[np.ndarray, "3 3"],
    points_camera: Float[np.ndarray, "*batch 3"],
    nearest_m: float = 0.0,
) -> Float[np.ndarray, "*batch"]:
    """Return the depth (meters) measured where points project; 0 where it is unknown or the point is out of
    view or not farther than ``nearest_m``. Points may also be rays, in the depth camera's axes."""
    pixel, z = project(points_camera, intrinsics)
    return np.where(z > nearest_m, sample_nearest(depth, pixel), 0)


def back_project_pixels(
    pixel: Float[np.ndarray, "*batch 2"],
    intrinsics: Float[np.ndarray, "3 3"],
    depth: Float[np.ndarray, "depth_height depth_width"],
    depth_intrinsics: Float[np.ndarray, "3 3"],
) -> Float[np.ndarray, "*batch 3"]:
    """Back-project pixels by a depth image of the same camera center and axes; zero where it is unknown."""
    ray = unproject(pixel, intrinsics)
    return ray * lookup_depth(depth, depth_intrinsics, ray)[..., None]


def scale_intrinsics(
    intrinsics: Float[np.ndarray, "*batch 3 3"], from_size: tuple[int, int], to_size: tuple[int, int]
) -> Float[np.ndarray, "*batch 3 3"]:
    """Adapt intrinsics to a resized image; sizes are (height, width), pixels."""
    scaled = np.array(intrinsics, float)
    scaled[..., 0, :] *= to_size[1] / from_size[1]
    scaled[..., 1, :] *= to_size[0] / from_size[0]
    return scaled


def opencv_from_opengl(
    world_from_camera_opengl: Float[np.ndarray, "*batch 4 4"],
) -> Float[np.ndarray, "*batch 4 4"]:
    """Turn camera poses with OpenGL axes (y up, z backward) into OpenCV axes; the flip is its own inverse."""
    return world_from_camera_opengl @ OPENCV_FROM_OPENGL


def turn_intrinsics(
    intrinsics: Float[np.ndarray, "*batch 3 3"], size: tuple[int, int], quarter_turns: int
) -> Float[np.ndarray, "*batch 3 3"]:
    """Adapt intrinsics, pixels, to an image of (height, width) ``size`` turned clockwise by quarter turns."""
    turned = np.array(intrinsics, float)
    height, width = size
    for _ in range(quarter_turns % 4):
        before = turned.copy()
        turned[..., 0, 0], turned[..., 1, 1] = before[..., 1, 1], before[..., 0, 0]
        turned[..., 0, 2], turned[..., 1, 2] = height - before[..., 1, 2], before[..., 0, 2]
        height, width = width, height
    return turned


def turn_camera(
    world_from_camera: Float[np.ndarray, "*batch 4 4"], quarter_turns: int
) -> Float[np.ndarray, "*batch 4 4"]:
    """Adapt camera poses (OpenCV axes) to images turned clockwise by quarter turns."""
    before_from_after = np.eye(4)
    before_from_after[:2, :2] = np.linalg.matrix_power(np.array([[0.0, 1.0], [-1.0, 0.0]]), quarter_turns % 4)
    return world_from_camera @ before_from_after


def turn_image(
    image: Shaped[np.ndarray, "height width *channel"], quarter_turns: int
) -> Shaped[np.ndarray, "turned_height turned_width *channel"]:
    """Turn an image clockwise by quarter turns."""
    return np.ascontiguousarray(np.rot90(image, -quarter_turns, axes=(0, 1)))


def _stack(parts: list[Any]) -> Any:
    if isinstance(parts[0], np.ndarray | float | np.floating):
        return np.stack(parts, axis=-1)
    import torch

    return torch.stack(parts, dim=-1)
