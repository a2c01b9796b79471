"""A depth camera beside the color camera, as in Kinects and most RGB-D cameras.

`reproject` registers its depth to the color camera at about its own resolution, with a z-buffer for
occlusion.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from pipeline.geometry import cameras, rigid

NEAREST_M = 0.05
"""minimum depth in the color camera, meters"""


@dataclass(frozen=True)
class DepthCamera:
    """Intrinsics and extrinsics of a depth camera; both cameras have OpenCV axes."""

    intrinsics: Float[np.ndarray, "3 3"]
    """pixels of the depth picture as stored"""
    depth_from_color: Float[np.ndarray, "4 4"]
    """rigid, meters"""
    size: tuple[int, int]
    """(height, width) of the depth picture as stored, pixels"""

    @property
    def baseline_m(self) -> float:
        """Distance between the two cameras, meters."""
        return float(np.linalg.norm(self.depth_from_color[:3, 3]))


def grid_size(depth_size: tuple[int, int], color_size: tuple[int, int]) -> tuple[int, int]:
    """Return the (height, width) of reprojected depth: the color's aspect ratio, the depth's longer side."""
    share = max(depth_size) / max(color_size)
    return round(color_size[0] * share), round(color_size[1] * share)


def reproject(
    depth: Float[np.ndarray, "depth_height depth_width"],
    camera: DepthCamera,
    color_intrinsics: Float[np.ndarray, "3 3"],
    color_size: tuple[int, int],
) -> Float[np.ndarray, "height width"]:
    """Return the depth that the color camera would measure, meters, 0 = unknown, on a grid of `grid_size`.

    Every known pixel is splatted to the cells that its footprint covers, the nearest surface wins.
    """
    height, width = size = grid_size(depth.shape, color_size)
    intrinsics = cameras.scale_intrinsics(color_intrinsics, color_size, size)
    known = depth > 0
    points_depth = cameras.back_project(depth, camera.intrinsics)[known]
    pixel, z = cameras.project(rigid.apply(rigid.inverse(camera.depth_from_color), points_depth), intrinsics)
    ahead = z > NEAREST_M
    pixel, z = pixel[ahead], z[ahead].astype(np.float32)
    footprint = intrinsics[[0, 1], [0, 1]] / camera.intrinsics[[0, 1], [0, 1]]
    cells = max(1, int(np.ceil(footprint.max())))
    nearest = np.full(height * width, np.inf, np.float32)
    for down in range(cells):
        for right in range(cells):
            corner = np.floor(pixel - (cells - 1) / 2).astype(int) + np.array([right, down])
            inside = (corner >= 0).all(1) & (corner < (width, height)).all(1)
            np.minimum.at(nearest, corner[inside, 1] * width + corner[inside, 0], z[inside])
    return np.where(np.isfinite(nearest), nearest, np.float32(0)).reshape(size)
