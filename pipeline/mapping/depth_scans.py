"""Point-to-plane correspondences between depth scans and a surface, for `pipeline.mapping.pose_optimization`.

`scan` subsamples a depth image to points with their noise; `SurfaceMap` finds their nearest vertices;
`measure_fit` measures how much of the depth lies on the surface.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy.spatial import KDTree

from pipeline.geometry import cameras, rigid, subsampling
from pipeline.geometry.meshes import Mesh
from pipeline.mapping.pose_optimization import MAP, Correspondences

NOISE_M, NOISE_SHARE = 0.008, 0.004
"""Noise of phone LiDAR: 8 mm and 0.4 % of the depth, meters."""
MAX_DEPTH_M = 4.5
"""Phone LiDAR is unreliable beyond this, meters."""
MIN_DEPTH_M = 0.1
"""Smaller depth counts as missing, meters."""
MAX_STEP_M, MAX_STEP_SHARE = 0.05, 0.05
"""Pixels whose neighbor differs by more (meters plus share of the depth) are depth edges and not used."""
SPAN_PX, MAX_NORMAL_STEP_M, MAX_NORMAL_STEP_SHARE = 4, 0.05, 0.06
"""Span of the differences of `image_normals`, and the same over it."""
QUERY_RADIUS_RATIO = 1.5
"""Search radius over reach: the nearest vertex may be farther than the plane through it."""
MIN_FIT_POINTS = 20
"""Least points for measuring a frame's fit."""
NEAR_M, FIT_M = 0.5, 0.05
"""Depth farther from the surface than the first is ignored as foreign; within the second it fits, meters."""


@dataclass(frozen=True)
class Scan:
    """Depth points of one frame in its camera frame, with standard deviations."""

    points_camera: Float[np.ndarray, "point 3"]
    sigma_m: Float[np.ndarray, "point"]
    pixel_index: Int[np.ndarray, "point"]
    """Row-major index into the depth image."""

    def subsampled(self, max_points: int) -> "Scan":
        """Keep at most ``max_points``, evenly spaced."""
        chosen = subsampling.evenly(len(self.sigma_m), max_points)
        return Scan(self.points_camera[chosen], self.sigma_m[chosen], self.pixel_index[chosen])


def depth_noise(depth_m: Float[np.ndarray, "*any"]) -> Float[np.ndarray, "*any"]:
    """Return the standard deviation of phone LiDAR depth, meters."""
    return NOISE_M + NOISE_SHARE * depth_m


def image_normals(
    depth: Float[np.ndarray, "height width"], intrinsics: Float[np.ndarray, "3 3"]
) -> Float[np.ndarray, "height width 3"]:
    """Return camera-facing unit normals by central differences; zero at depth edges and unknown depth."""
    points = cameras.back_project(depth, intrinsics)
    normals = np.zeros_like(points)
    inner = slice(SPAN_PX, -SPAN_PX)
    right = points[inner, 2 * SPAN_PX :] - points[inner, : -2 * SPAN_PX]
    down = points[2 * SPAN_PX :, inner] - points[: -2 * SPAN_PX, inner]
    cross = np.cross(down, right)
    length = np.linalg.norm(cross, axis=-1)
    center = depth[inner, inner]
    limit = MAX_NORMAL_STEP_M + MAX_NORMAL_STEP_SHARE * center
    known = (center > 0) & (length > 1e-9) & (np.abs(right[..., 2]) < limit) & (np.abs(down[..., 2]) < limit)
    for end in (slice(2 * SPAN_PX, None), slice(None, -2 * SPAN_PX)):
        known &= (depth[inner, end] > 0) & (depth[end, inner] > 0)
    normals[inner, inner] = np.where(known[..., None], cross / np.maximum(length, 1e-9)[..., None], 0)
    return normals


def scan(
    depth: Float[np.ndarray, "height width"],
    intrinsics: Float[np.ndarray, "3 3"],
    *,
    stride: int,
    confidence: UInt8[np.ndarray, "height width"] | None = None,
    ignore: Bool[np.ndarray, "height width"] | None = None,
    max_depth_m: float = MAX_DEPTH_M,
) -> Scan:
    """Keep every ``stride``-th pixel with known depth (meters) and confidence >= 1, away from depth edges."""
    usable = (depth > MIN_DEPTH_M) & (depth < max_depth_m)
    if confidence is not None:
        usable &= confidence >= 1
    if ignore is not None:
        usable &= ~ignore
    step = np.maximum(
        np.abs(np.diff(depth, axis=0, append=depth[-1:])),
        np.abs(np.diff(depth, axis=1, append=depth[:, -1:])),
    )
    usable &= step < MAX_STEP_M + MAX_STEP_SHARE * depth
    offset = stride // 2
    grid = np.zeros_like(usable)
    grid[offset::stride, offset::stride] = True
    index = np.flatnonzero(usable & grid)
    points = cameras.back_project(depth, intrinsics).reshape(-1, 3)[index]
    return Scan(points, depth_noise(points[:, 2]), index)


class SurfaceMap:
    """A mesh's vertices and normals, ready for nearest-neighbor queries."""

    def __init__(self, mesh: Mesh):
        normals = mesh.vertex_normals()
        used = np.linalg.norm(normals, axis=1) > 0.5
        self.points_world, self.normals_world = np.asarray(mesh.vertices, float)[used], normals[used]
        self._tree = KDTree(self.points_world)

    def correspondences(
        self,
        frames: Int[np.ndarray, "scan"],
        scans: list[Scan],
        world_from_camera: Float[np.ndarray, "frame 4 4"],
        reach_m: float,
        inflation: float = 1.0,
    ) -> Correspondences:
        """Pair scan points with the tangent plane of the nearest camera-facing vertex within reach (meters).

        ``inflation`` multiplies the depth noise, since errors of neighboring pixels are correlated.
        """
        first = np.repeat(frames, [len(scan.points_camera) for scan in scans])
        points = np.concatenate([scan.points_camera for scan in scans])
        sigma = np.concatenate([scan.sigma_m for scan in scans])
        poses = world_from_camera[frames]
        world = [rigid.apply(pose, scan.points_camera) for pose, scan in zip(poses, scans, strict=True)]
        world = np.concatenate(world)
        distance, nearest = self._tree.query(world, distance_upper_bound=QUERY_RADIUS_RATIO * reach_m)
        matched = np.flatnonzero(np.isfinite(distance))
        nearest, first, world = np.asarray(nearest)[matched], first[matched], world[matched]
        normal = self.normals_world[nearest]
        facing = np.einsum("ci,ci->c", normal, world_from_camera[first, :3, 3] - world) > 0
        matched, points_second = matched[facing], self.points_world[nearest[facing]]
        second, sigma = np.full(len(matched), MAP), inflation * sigma[matched]
        return Correspondences(first[facing], second, points[matched], points_second, normal[facing], sigma)

    def distance(self, points_world: Float[np.ndarray, "point 3"]) -> Float[np.ndarray, "point"]:
        """Return signed point-to-plane distances to the nearest vertex, meters; negative behind it."""
        _, nearest = self._tree.query(points_world)
        return np.einsum("pi,pi->p", points_world - self.points_world[nearest], self.normals_world[nearest])


def measure_fit(
    surface: SurfaceMap, scans: list[Scan], world_from_camera: Float[np.ndarray, "frame 4 4"]
) -> tuple[Float[np.ndarray, "frame"], Float[np.ndarray, "frame"]]:
    """Return each scan's median distance from the surface, meters, and its share within 5 cm of it.

    Both count points within 50 cm, and are NaN with too few points; the share is 0 if too few are that near.
    """
    gap, fit = np.full(len(scans), np.nan), np.full(len(scans), np.nan)
    for frame, scan in enumerate(scans):
        if len(scan.points_camera) >= MIN_FIT_POINTS:
            distance = np.abs(surface.distance(rigid.apply(world_from_camera[frame], scan.points_camera)))
            near, fit[frame] = distance[distance < NEAR_M], 0.0
            if len(near) >= MIN_FIT_POINTS:
                gap[frame], fit[frame] = np.median(near), (near < FIT_M).mean()
    return gap, fit
