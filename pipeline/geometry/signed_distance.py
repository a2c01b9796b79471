"""Signed distance field of a scene, negative inside solids. World frame, meters.

`from_mesh` computes it on a voxel grid: distance from dense surface samples, sign from a vote of rays, which
tolerates open meshes. `SignedDistance.at` interpolates it differentiably.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float
from scipy import ndimage
from scipy.spatial import KDTree
from torch import Tensor
from torch.nn import functional

from pipeline.geometry.meshes import Mesh, RayCaster, area_normals

SPACING_M = 0.015
"""mean distance of surface samples"""
R2_SEQUENCE = (0.7548776662466927, 0.5698402909980532)
"""1 / g and 1 / g^2 of the plastic number g: multiples of them, modulo 1, are even and repeatable"""
RAYS = np.array(
    [
        [np.sin(turn + rise), rise, np.cos(turn + rise)]
        for turn in np.arange(4) * np.pi / 2 + 0.4
        for rise in (-0.3, 0.25, 1.0)
    ]
)
"""Ray directions of the vote: all around, more up than down, since scans of furniture often lack a bottom."""


@dataclass(frozen=True)
class SignedDistance:
    """Distances at the centers of voxels."""

    values: Float[Tensor, "x y z"]
    origin: Float[Tensor, "3"]
    """world position of the center of the first voxel"""
    voxel_m: float

    def at(self, points_world: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
        """Interpolate trilinearly, with border values outside the grid."""
        scale = 2 / (self.voxel_m * (torch.tensor(self.values.shape) - 1)).to(points_world)
        offset = -1 - scale * self.origin.to(points_world)
        place = torch.addcmul(offset, points_world, scale).reshape(1, -1, 1, 1, 3)
        values = self.values.to(points_world).permute(2, 1, 0)[
            None, None
        ]  # grid_sample counts the last axis first
        read = functional.grid_sample(
            values, place, mode="bilinear", padding_mode="border", align_corners=True
        )
        return read.reshape(points_world.shape[:-1])


@dataclass(frozen=True)
class SurfacePoints:
    """Points spread evenly over a surface, with unit normals; world frame."""

    points: Float[np.ndarray, "point 3"]
    normals: Float[np.ndarray, "point 3"]


def surface_points(mesh: Mesh, spacing_m: float) -> SurfacePoints:
    """Spread points over all faces, about one per square of ``spacing_m``, the same for the same mesh."""
    corner = np.asarray(mesh.vertices, np.float64)[mesh.faces]
    normal = area_normals(corner)
    twice_area = np.linalg.norm(normal, axis=1)
    wanted = twice_area / 2 / spacing_m**2
    ends = np.floor(np.cumsum(wanted) + 0.5).astype(np.int64)
    face = np.repeat(np.arange(len(ends)), np.diff(ends, prepend=0))
    index = np.arange(len(face))
    u, v = ((index * step) % 1 for step in R2_SEQUENCE)
    fold = u + v > 1
    u, v = np.where(fold, 1 - u, u), np.where(fold, 1 - v, v)
    edges = corner[face, 1] - corner[face, 0], corner[face, 2] - corner[face, 0]
    points = corner[face, 0] + u[:, None] * edges[0] + v[:, None] * edges[1]
    return SurfacePoints(points, normal[face] / np.maximum(twice_area[face], 1e-12)[:, None])


def voxel_centers(
    low: Float[np.ndarray, "3"], high: Float[np.ndarray, "3"], voxel_m: float
) -> Float[np.ndarray, "x y z 3"]:
    """Return the centers of the voxels between two corners of a box, the first one at ``low``; meters."""
    shape = np.maximum(np.ceil((np.asarray(high, float) - low) / voxel_m).astype(int), 2)
    axes = [low[axis] + voxel_m * np.arange(shape[axis]) for axis in range(3)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)


def from_mesh(
    mesh: Mesh, low: Float[np.ndarray, "3"], high: Float[np.ndarray, "3"], *, voxel_m: float = 0.04
) -> SignedDistance:
    """Compute the signed distance of a mesh with outward faces, in a box between two corners.

    A voxel is inside if more rays first hit the back of a face than the front; far from surfaces a majority
    filter corrects it. Surfaces with solid on both sides, which fusion leaves in walls, are ignored, since
    their gradient would lead deeper.
    """
    grid, surface = voxel_centers(low, high, voxel_m), surface_points(mesh, SPACING_M)
    centers, shape = grid.reshape(-1, 3), grid.shape[:3]
    inside, coarse_m = _inside(mesh, centers).reshape(shape), _distance_to_points(surface, grid, voxel_m)
    solid = _majority(inside, coarse_m, voxel_m)
    surface = _without_interior(surface, solid, np.asarray(low, np.float64), voxel_m)
    distance = _distance_to_points(surface, grid, voxel_m).reshape(-1)
    near = np.flatnonzero(distance < 3 * voxel_m)
    distance[near] = _distance_to_patches(surface, centers[near], SPACING_M)
    values = torch.from_numpy(np.where(solid, -1.0, 1.0) * distance.reshape(shape)).float()
    return SignedDistance(values, torch.from_numpy(np.asarray(low, np.float64)).float(), voxel_m)


def _majority(
    solid: Bool[np.ndarray, "x y z"], distance_m: Float[np.ndarray, "x y z"], voxel_m: float
) -> Bool[np.ndarray, "x y z"]:
    """Apply a majority filter in boxes that contain no surface, small boxes first."""
    for reach in (1, 2, 4):
        share = ndimage.uniform_filter(solid.astype(np.float32), 2 * reach + 1, mode="nearest")
        solid = np.where(distance_m > np.sqrt(3) * reach * voxel_m, share > 0.5, solid)
    return solid


def _without_interior(
    surface: SurfacePoints, solid: Bool[np.ndarray, "x y z"], low: Float[np.ndarray, "3"], voxel_m: float
) -> SurfacePoints:
    """Remove points with solid on both sides."""

    def within(side: float) -> np.ndarray:
        index = np.rint((surface.points + side * voxel_m * surface.normals - low) / voxel_m).astype(np.int64)
        return solid[tuple(np.clip(index, 0, np.array(solid.shape) - 1).T)]

    retained = ~(within(1) & within(-1))
    return SurfacePoints(surface.points[retained], surface.normals[retained])


def _distance_to_points(
    surface: SurfacePoints, centers: Float[np.ndarray, "x y z 3"], voxel_m: float
) -> Float[np.ndarray, "x y z"]:
    """Return the distance to a point of the nearest voxel with points: fast, accurate to half a voxel."""
    shape = centers.shape[:3]
    index = np.rint((surface.points - centers[0, 0, 0]) / voxel_m).astype(np.int64)
    inside = ((index >= 0) & (index < shape)).all(1)
    flat = np.ravel_multi_index(index[inside].T, shape)
    chosen = np.full(np.prod(shape), -1)
    chosen[flat] = np.flatnonzero(inside)
    if not len(flat):
        return np.full(shape, np.inf)
    far = (chosen < 0).reshape(shape)
    nearest = np.asarray(ndimage.distance_transform_edt(far, return_distances=False, return_indices=True))
    return np.linalg.norm(centers - surface.points[chosen.reshape(shape)[tuple(nearest)]], axis=-1)


def _distance_to_patches(
    surface: SurfacePoints, points: Float[np.ndarray, "point 3"], spacing_m: float
) -> Float[np.ndarray, "point"]:
    """Return the distance to the planar patch around the nearest surface point."""
    _, nearest = KDTree(surface.points).query(points)
    offset = points - surface.points[nearest]
    normal = np.abs(np.einsum("pi,pi->p", offset, surface.normals[nearest]))
    tangential = np.sqrt(np.maximum((offset**2).sum(1) - normal**2, 0))
    return np.hypot(normal, np.maximum(tangential - spacing_m, 0))


def _inside(mesh: Mesh, points: Float[np.ndarray, "point 3"]) -> np.ndarray:
    caster, normals = RayCaster(mesh), mesh.face_normals()
    votes = np.zeros(len(points), np.int64)
    for direction in RAYS:
        hits = caster.cast(points, np.broadcast_to(direction, points.shape))
        votes += np.where(hits.face >= 0, np.sign(normals[np.maximum(hits.face, 0)] @ direction), 0).astype(
            np.int64
        )
    return votes > 0
