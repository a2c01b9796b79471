"""Depth against a surface: which measured points touch which place of a mesh, as contacts for `pipeline.space.relax`.

`scan` thins a depth image to points with their noise; `Surface` finds the nearest places, point to plane.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy.spatial import cKDTree

from pipeline.space import cameras, rigid
from pipeline.space.meshes import Mesh
from pipeline.space.relax import MAP, Contacts


@dataclass(frozen=True)
class Scan:
    """Points that one frame measured, in camera axes, and their standard deviation along any direction."""

    points_camera: Float[np.ndarray, "point 3"]
    sigma_m: Float[np.ndarray, "point"]
    pixel_index: Int[np.ndarray, "point"]
    """Row-major index into the depth image."""

    def thinned(self, most: int) -> "Scan":
        """Keep at most so many points, spread evenly over the picture."""
        count = len(self.sigma_m)
        kept = np.unique(np.linspace(0, max(count - 1, 0), min(most, count)).astype(int))
        return Scan(self.points_camera[kept], self.sigma_m[kept], self.pixel_index[kept])


def depth_noise(depth_m: Float[np.ndarray, "*any"]) -> Float[np.ndarray, "*any"]:
    """Return the standard deviation to expect of phone LiDAR at a depth: 8 mm and 0.4 % of it."""
    return 0.008 + 0.004 * depth_m


def image_normals(
    depth: Float[np.ndarray, "height width"], intrinsics: Float[np.ndarray, "3 3"], span_px: int = 4
) -> Float[np.ndarray, "height width 3"]:
    """Return unit normals towards the camera from central differences over ``span_px``; zero at edges and unknown
    depth.
    """
    points = cameras.back_project(depth, intrinsics)
    normals = np.zeros_like(points)
    inner = slice(span_px, -span_px)
    right = points[inner, 2 * span_px :] - points[inner, : -2 * span_px]
    down = points[2 * span_px :, inner] - points[: -2 * span_px, inner]
    cross = np.cross(down, right)
    length = np.linalg.norm(cross, axis=-1)
    centre = depth[inner, inner]
    limit = 0.05 + 0.06 * centre
    known = (centre > 0) & (length > 1e-9) & (np.abs(right[..., 2]) < limit) & (np.abs(down[..., 2]) < limit)
    for shifted in (
        depth[inner, 2 * span_px :],
        depth[inner, : -2 * span_px],
        depth[2 * span_px :, inner],
        depth[: -2 * span_px, inner],
    ):
        known &= shifted > 0
    normals[inner, inner] = np.where(known[..., None], cross / np.maximum(length, 1e-9)[..., None], 0)
    return normals


def scan(
    depth: Float[np.ndarray, "height width"],
    intrinsics: Float[np.ndarray, "3 3"],
    *,
    stride: int,
    confidence: UInt8[np.ndarray, "height width"] | None = None,
    ignore: Bool[np.ndarray, "height width"] | None = None,
    furthest_m: float = 4.5,
) -> Scan:
    """Keep one pixel in ``stride`` each way where depth is known, trusted (confidence >= 1) and no jump is near."""
    usable = (depth > 0.1) & (depth < furthest_m)
    if confidence is not None:
        usable &= confidence >= 1
    if ignore is not None:
        usable &= ~ignore
    step = np.maximum(np.abs(np.diff(depth, axis=0, append=depth[-1:])), np.abs(np.diff(depth, axis=1, append=depth[:, -1:])))
    usable &= step < 0.05 + 0.05 * depth
    offset = stride // 2
    grid = np.zeros_like(usable)
    grid[offset::stride, offset::stride] = True
    index = np.flatnonzero(usable & grid)
    points = cameras.back_project(depth, intrinsics).reshape(-1, 3)[index]
    return Scan(points, depth_noise(points[:, 2]), index)


class Surface:
    """A mesh's vertices and normals, ready for nearest-neighbour queries."""

    def __init__(self, mesh: Mesh):
        normals = mesh.vertex_normals()
        used = np.linalg.norm(normals, axis=1) > 0.5
        self.points_world, self.normals_world = np.asarray(mesh.vertices, float)[used], normals[used]
        self._tree = cKDTree(self.points_world)

    def contacts(
        self,
        frames: Int[np.ndarray, "scan"],
        scans: list[Scan],
        world_from_camera: Float[np.ndarray, "frame 4 4"],
        reach_m: float,
    ) -> Contacts:
        """Pair every scanned point with the nearest place in reach whose normal faces the camera, point to plane."""
        first = np.repeat(frames, [len(scan.points_camera) for scan in scans])
        points = np.concatenate([scan.points_camera for scan in scans])
        sigma = np.concatenate([scan.sigma_m for scan in scans])
        world = np.concatenate(
            [rigid.apply(world_from_camera[frame], scan.points_camera) for frame, scan in zip(frames, scans, strict=True)]
        )
        distance, nearest = self._tree.query(world, distance_upper_bound=reach_m * 1.5)
        found = np.flatnonzero(np.isfinite(distance))
        nearest, first, world = nearest[found], first[found], world[found]
        normal = self.normals_world[nearest]
        facing = np.einsum("ci,ci->c", normal, world_from_camera[first, :3, 3] - world) > 0
        found, nearest, first, normal = found[facing], nearest[facing], first[facing], normal[facing]
        return Contacts(first, np.full(len(found), MAP), points[found], self.points_world[nearest], normal, sigma[found])

    def distance(self, points_world: Float[np.ndarray, "point 3"]) -> Float[np.ndarray, "point"]:
        """Return the distance along the nearest normal, negative behind the surface, metres."""
        _, nearest = self._tree.query(points_world)
        return np.einsum("pi,pi->p", points_world - self.points_world[nearest], self.normals_world[nearest])
