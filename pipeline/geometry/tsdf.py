"""TSDF fusion of posed depth and color, and extraction of the observed surface (Curless and Levoy 1996).

`enclose` makes an empty volume around points, `Volume.integrate` fuses a frame, `Volume.surface` extracts the
mesh.
"""

import numpy as np
from jaxtyping import Float, UInt8
from numba import njit
from skimage import measure

from pipeline.geometry import rigid
from pipeline.geometry.meshes import Mesh

CORNER_SHARE = 1e-4
"""added to trilinear weights, so that a point at a corner without color takes its neighbors' colors"""
FREE_GAIN = 0.2
"""Weight of free-space observations against surface ones, to keep rims and thin legs."""


class Volume:
    """A dense grid of signed distance (positive in free space, in truncations), weight and color."""

    def __init__(
        self, origin: Float[np.ndarray, "3"], shape: tuple[int, int, int], voxel_m: float, truncation_m: float
    ):
        self.origin = np.asarray(origin, float)
        """World position of the center of voxel 0."""
        self.voxel_m, self.truncation_m = voxel_m, truncation_m
        self.distance = np.ones(shape, np.float32)
        self.weight = np.zeros(shape, np.float32)
        self.color = np.zeros((*shape, 3), np.float32)
        self.color_weight = np.zeros(shape, np.float32)

    def integrate(
        self,
        depth: Float[np.ndarray, "height width"],
        depth_intrinsics: Float[np.ndarray, "3 3"],
        color: UInt8[np.ndarray, "color_height color_width 3"],
        intrinsics: Float[np.ndarray, "3 3"],
        world_from_camera: Float[np.ndarray, "4 4"],
        trust: Float[np.ndarray, "height width"] | None = None,
    ) -> None:
        """Add one frame; depth 0 is unknown and changes nothing. Near views weigh more (1 / depth squared),
        times the trust (0..1)."""
        trust = np.ones(depth.shape, np.float32) if trust is None else np.ascontiguousarray(trust, np.float32)
        camera_from_world = rigid.inverse(world_from_camera)
        start = camera_from_world[:3, :3] @ self.origin + camera_from_world[:3, 3]
        steps = np.ascontiguousarray(camera_from_world[:3, :3].T * self.voxel_m)
        grids = self.distance, self.weight, self.color, self.color_weight
        depths = np.ascontiguousarray(depth, np.float32), trust, _focal(depth_intrinsics)
        colors = np.ascontiguousarray(color), _focal(intrinsics)
        _integrate(*grids, start, steps, *depths, *colors, self.truncation_m)

    def surface(self, min_weight: float) -> Mesh:
        """Extract the zero crossing between voxels seen often enough; what was never seen stays open."""
        seen = self.weight > min_weight
        if not seen.any() or self.distance[seen].min() > 0:
            return Mesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32), np.zeros((0, 3), np.uint8))
        vertices, faces, _, _ = measure.marching_cubes(
            self.distance, 0.0, mask=seen, gradient_direction="descent"
        )
        cell = np.floor(vertices[faces].mean(1)).astype(int)
        corners = cell[:, None] + np.array(list(np.ndindex(2, 2, 2)))
        faces = faces[seen[tuple(np.moveaxis(np.minimum(corners, np.array(seen.shape) - 1), -1, 0))].all(1)]
        used, faces = np.unique(faces, return_inverse=True)
        vertices, faces = vertices[used], faces.reshape(-1, 3)
        color = self._color_at(vertices)
        return Mesh((vertices * self.voxel_m + self.origin).astype(np.float32), faces.astype(np.int32), color)

    def _color_at(self, grid_points):
        low = np.clip(np.floor(grid_points).astype(int), 0, np.array(self.weight.shape) - 2)
        part = grid_points - low
        color, total = np.zeros((len(low), 3)), np.full((len(low), 1), 1e-9)
        for corner in np.ndindex(2, 2, 2):
            share = np.prod(np.where(corner, part, 1 - part), axis=1) + CORNER_SHARE
            index = tuple((low + corner).T)
            weight = (share * (self.color_weight[index] > 0))[:, None]
            color += weight * self.color[index]
            total += weight
        return np.clip(np.round(color / total), 0, 255).astype(np.uint8)


def enclose(
    points_world: Float[np.ndarray, "point 3"], *, voxel_m: float, truncation_m: float, trim: float = 0.001
) -> Volume:
    """Return an empty volume around the points, without the outermost share ``trim`` on each side."""
    low, high = np.quantile(points_world, [trim, 1 - trim], axis=0)
    margin = truncation_m + 2 * voxel_m
    shape = np.ceil((high - low + 2 * margin) / voxel_m).astype(int) + 1
    return Volume(low - margin, tuple(shape), voxel_m, truncation_m)


def _focal(intrinsics):
    return np.array([intrinsics[0, 0], intrinsics[1, 1], intrinsics[0, 2], intrinsics[1, 2]], float)


@njit(cache=True, nogil=True)
def _integrate(
    distance, weight, color, color_weight, start, steps, depth, trust, depth_focal, image, focal, truncation_m
):
    for i in range(distance.shape[0]):
        for j in range(distance.shape[1]):
            x0 = start[0] + i * steps[0, 0] + j * steps[1, 0]
            y0 = start[1] + i * steps[0, 1] + j * steps[1, 1]
            z0 = start[2] + i * steps[0, 2] + j * steps[1, 2]
            for k in range(distance.shape[2]):
                z = z0 + k * steps[2, 2]
                if z < 0.1:
                    continue
                x = (x0 + k * steps[2, 0]) / z
                y = (y0 + k * steps[2, 1]) / z
                column = int(np.floor(x * depth_focal[0] + depth_focal[2]))
                row = int(np.floor(y * depth_focal[1] + depth_focal[3]))
                if row < 0 or column < 0 or row >= depth.shape[0] or column >= depth.shape[1]:
                    continue
                measured = depth[row, column]
                if measured <= 0:
                    continue
                gap = measured - z
                if gap < -truncation_m:
                    continue
                gain = trust[row, column] / max(measured * measured, 0.25)
                if gap > truncation_m:
                    gain *= FREE_GAIN
                total = weight[i, j, k] + gain + 1e-9
                distance[i, j, k] += (min(1.0, gap / truncation_m) - distance[i, j, k]) * gain / total
                weight[i, j, k] = total
                if abs(gap) < 0.5 * truncation_m:
                    column = int(np.floor(x * focal[0] + focal[2]))
                    row = int(np.floor(y * focal[1] + focal[3]))
                    if row >= 0 and column >= 0 and row < image.shape[0] and column < image.shape[1]:
                        total = color_weight[i, j, k] + gain + 1e-9
                        for channel in range(3):
                            color[i, j, k, channel] += (
                                (image[row, column, channel] - color[i, j, k, channel]) * gain / total
                            )
                        color_weight[i, j, k] = total
