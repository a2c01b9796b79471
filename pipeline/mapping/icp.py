"""Projective point-to-plane ICP between depth images with robust weights.

`depth_image` prepares points and normals, `align_views` refines the motion between two depth images and
returns its information matrix. The robust weights reject moving objects as outliers.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numba
import numpy as np
from jaxtyping import Bool, Float

from pipeline.geometry import cameras, rigid

MIN_DEPTH_M = 0.05
"""Points nearer to the target camera are not projected, meters."""
MIN_COSINE = 0.7
"""Least cosine between the normals of a correspondence (45 degrees)."""
POINTS_PER_MEASUREMENT = 20
"""Points per independent measurement, since errors of neighboring pixels are correlated."""
NOISE_FLOOR_M = 0.005
"""Least noise assumed in the information matrix, meters: phone depth is no better."""
DAMPING = 1e-3
"""Levenberg-Marquardt damping per unit of weight; keeps flat walls solvable."""
CONVERGED = 1e-5
"""Steps below this (radians, meters) end the iteration."""
NORMAL_JUMP, NORMAL_JUMP_DEPTH_M = 0.06, 0.5
"""Depth edge: neighbors differ by more than this share of the depth, or of this depth (meters) if larger."""


@dataclass(frozen=True)
class DepthImage:
    """Points (meters) and unit normals of a depth image in its camera frame."""

    points: Float[np.ndarray, "height width 3"]
    normals: Float[np.ndarray, "height width 3"]
    """Zero at unknown depth and depth edges."""
    intrinsics: Float[np.ndarray, "3 3"]


@dataclass(frozen=True)
class IcpResult:
    """A refined motion with the information (inverse covariance) of its twist in the target's frame."""

    target_from_source: Float[np.ndarray, "4 4"]
    information: Float[np.ndarray, "6 6"]
    overlap: float
    """Share of the projected source points that have a correspondence."""
    residual_m: float
    """Weighted RMS point-to-plane distance, meters."""


def depth_image(
    depth: Float[np.ndarray, "height width"],
    intrinsics: Float[np.ndarray, "3 3"],
    usable: Bool[np.ndarray, "height width"],
    stride: int,
) -> DepthImage:
    """Compute points and normals of a depth image (meters, 0 = unknown) at every ``stride``-th pixel."""
    grid = np.s_[stride // 2 :: stride, stride // 2 :: stride]
    points = cameras.back_project(depth, intrinsics)[grid].astype(np.float32)
    points[~(usable & (depth > 0))[grid]] = 0
    scaled = intrinsics.copy()
    scaled[:2, 2] = (intrinsics[:2, 2] - stride // 2 - 0.5) / stride + 0.5
    scaled[:2, :2] /= stride
    return DepthImage(points, _normals(points), scaled)


def depth_views(
    depth_of: Callable[[int], Float[np.ndarray, "height width"]],
    intrinsics: Float[np.ndarray, "frame 3 3"],
    stride: int,
) -> Callable[[int], DepthImage]:
    """Return what computes the `depth_image` of a frame from its depth."""

    def view(frame: int) -> DepthImage:
        depth = depth_of(frame)
        return depth_image(depth, intrinsics[frame], depth > 0, stride)

    return view


def align_views(
    target: DepthImage,
    source: DepthImage,
    target_from_source: Float[np.ndarray, "4 4"],
    *,
    reach_m: float,
    iterations: int,
) -> IcpResult:
    """Refine ``target_from_source`` by projective point-to-plane ICP (Chen and Medioni 1992).

    Tukey's weights reject points farther than ``reach_m`` from the surface they project to; the reach halves
    half-way. The information counts `POINTS_PER_MEASUREMENT` points as one measurement.
    """
    target_from_source = np.array(target_from_source, float)
    focal = target.intrinsics[[0, 1, 0, 1], [0, 1, 2, 2]].astype(np.float32)
    hessian, squares, weight, overlap = np.zeros((6, 6)), 0.0, 0.0, 0.0
    for iteration in range(iterations):
        reach = reach_m * (0.5 if iteration >= iterations // 2 else 1.0)
        rotation = np.ascontiguousarray(target_from_source[:3, :3], np.float32)
        motion = rotation, target_from_source[:3, 3].astype(np.float32)
        images = target.points, target.normals, source.points, source.normals
        sums = _accumulate(*images, *motion, focal, np.float32(reach))
        hessian, gradient, squares, weight, overlap = sums
        step = -np.linalg.solve(hessian + np.eye(6) * (DAMPING * max(weight, 1.0)), gradient)
        target_from_source = rigid.exp(step) @ target_from_source
        if np.abs(step).max() < CONVERGED:
            break
    residual = float(np.sqrt(squares / max(weight, 1e-9)))
    noise = max(residual, NOISE_FLOOR_M)
    return IcpResult(target_from_source, hessian / (POINTS_PER_MEASUREMENT * noise**2), overlap, residual)


def _normals(points: Float[np.ndarray, "height width 3"]) -> Float[np.ndarray, "height width 3"]:
    """Return camera-facing unit normals by central differences; zero at depth edges and the image border."""
    normals = np.zeros_like(points)
    across = points[1:-1, 2:] - points[1:-1, :-2]
    down = points[2:, 1:-1] - points[:-2, 1:-1]
    z = points[..., 2]
    neighbors = np.stack([z[1:-1, 2:], z[1:-1, :-2], z[2:, 1:-1], z[:-2, 1:-1], z[1:-1, 1:-1]])
    smooth = (neighbors.min(0) > 0) & (
        np.ptp(neighbors, axis=0) < NORMAL_JUMP * np.maximum(neighbors[-1], NORMAL_JUMP_DEPTH_M)
    )
    normal = np.cross(down, across)
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-9)
    normal *= np.where((normal * points[1:-1, 1:-1]).sum(-1, keepdims=True) > 0, -1, 1)
    normals[1:-1, 1:-1] = np.where(smooth[..., None], normal, 0)
    return normals


@numba.njit(cache=True)
def _accumulate(
    target_points, target_normals, source_points, source_normals, rotation, translation, focal, reach
):
    """Accumulate the normal equations of one Gauss-Newton step for a left-hand twist (target frame)."""
    hessian, gradient = np.zeros((6, 6)), np.zeros(6)
    squares, total_weight, matched, projected = 0.0, 0.0, 0.0, 0.0
    height, width = target_points.shape[:2]
    row = np.zeros(6)
    for i in range(source_points.shape[0]):
        for j in range(source_points.shape[1]):
            normal_source = source_normals[i, j]
            if normal_source[0] == 0 and normal_source[1] == 0 and normal_source[2] == 0:
                continue
            p = rotation @ source_points[i, j] + translation
            if p[2] < MIN_DEPTH_M:
                continue
            x = int(np.floor(p[0] / p[2] * focal[0] + focal[2]))
            y = int(np.floor(p[1] / p[2] * focal[1] + focal[3]))
            if x < 0 or y < 0 or x >= width or y >= height:
                continue
            n, q = target_normals[y, x], target_points[y, x]
            if n[0] == 0 and n[1] == 0 and n[2] == 0:
                continue
            projected += 1.0
            d = p - q
            rotated_normal = rotation @ normal_source
            cosine = rotated_normal[0] * n[0] + rotated_normal[1] * n[1] + rotated_normal[2] * n[2]
            if d[0] * d[0] + d[1] * d[1] + d[2] * d[2] > 4 * reach * reach or cosine < MIN_COSINE:
                continue
            error = d[0] * n[0] + d[1] * n[1] + d[2] * n[2]
            if abs(error) >= reach:
                continue
            weight = (1 - (error / reach) ** 2) ** 2 / max(1.0, p[2] * p[2])
            row[0] = p[1] * n[2] - p[2] * n[1]
            row[1] = p[2] * n[0] - p[0] * n[2]
            row[2] = p[0] * n[1] - p[1] * n[0]
            row[3:] = n
            for a in range(6):
                gradient[a] += weight * error * row[a]
                for b in range(6):
                    hessian[a, b] += weight * row[a] * row[b]
            squares += weight * error * error
            total_weight += weight
            matched += 1.0
    return hessian, gradient, squares, total_weight, matched / max(projected, 1.0)
