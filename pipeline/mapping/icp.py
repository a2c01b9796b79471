"""Align depth pictures to one another: projective point-to-plane ICP with robust weights.

`depth_image` prepares points and normals, `align_views` refines the motion between two depth images and
returns its information matrix. Moving things are outliers that the robust weights leave out.
"""

from dataclasses import dataclass

import numba
import numpy as np
from jaxtyping import Bool, Float

from pipeline.geometry import cameras, rigid

NEAREST_M = 0.05
"""Points nearer to the target camera than this are not projected, metres."""
MIN_COSINE = 0.7
"""Normals of a pair must agree within 45 degrees."""
POINTS_PER_MEASUREMENT = 20
"""Neighbouring depth pixels err together: so many count as one independent measurement."""
NOISE_FLOOR_M = 0.005
"""The information assumes at least this noise, metres: phone depth is not better."""
DAMPING = 1e-3
"""Levenberg-Marquardt damping per unit of weight; keeps flat walls solvable."""
CONVERGED = 1e-5
"""Steps below this (radians, metres) end the iteration."""
NORMAL_JUMP, NORMAL_JUMP_DEPTH_M = 0.06, 0.5
"""Neighbours whose depth differs by more than this share of it (at least so many metres) bound a surface."""


@dataclass(frozen=True)
class DepthImage:
    """A depth picture as points and unit normals in its camera's axes, metres."""

    points: Float[np.ndarray, "height width 3"]
    normals: Float[np.ndarray, "height width 3"]
    """Zero where there is no depth or the surface breaks off."""
    intrinsics: Float[np.ndarray, "3 3"]


@dataclass(frozen=True)
class IcpResult:
    """A refined motion with the information (inverse covariance) of its twist in the target's frame."""

    target_from_source: Float[np.ndarray, "4 4"]
    information: Float[np.ndarray, "6 6"]
    overlap: float
    """Share of the source's points that met the target's surface."""
    residual_m: float
    """Root mean square distance to the planes of those, metres."""


def depth_image(
    depth: Float[np.ndarray, "height width"],
    intrinsics: Float[np.ndarray, "3 3"],
    usable: Bool[np.ndarray, "height width"],
    stride: int,
) -> DepthImage:
    """Prepare a depth picture (metres, 0 = unknown) at every ``stride``-th pixel."""
    every = np.s_[stride // 2 :: stride, stride // 2 :: stride]
    points = cameras.back_project(depth, intrinsics)[every].astype(np.float32)
    points[~(usable & (depth > 0))[every]] = 0
    scaled = intrinsics.copy()
    scaled[:2, 2] = (intrinsics[:2, 2] - stride // 2 - 0.5) / stride + 0.5
    scaled[:2, :2] /= stride
    return DepthImage(points, _normals(points), scaled)


def align_views(
    target: DepthImage,
    source: DepthImage,
    target_from_source: Float[np.ndarray, "4 4"],
    *,
    reach_m: float,
    iterations: int,
) -> IcpResult:
    """Refine ``target_from_source`` by projective point-to-plane ICP (Chen and Medioni 1992).

    Points farther than ``reach_m`` from the surface they project to are left out (Tukey's weights); the reach
    halves half-way. The information counts `POINTS_PER_MEASUREMENT` points as one measurement.
    """
    target_from_source = np.array(target_from_source, float)
    focal = target.intrinsics[[0, 1, 0, 1], [0, 1, 2, 2]].astype(np.float32)
    hessian, squares, weight, overlap = np.zeros((6, 6)), 0.0, 0.0, 0.0
    for iteration in range(iterations):
        reach = reach_m * (0.5 if iteration >= iterations // 2 else 1.0)
        rotation = np.ascontiguousarray(target_from_source[:3, :3], np.float32)
        motion = rotation, target_from_source[:3, 3].astype(np.float32)
        surfaces = target.points, target.normals, source.points, source.normals
        sums = _accumulate(*surfaces, *motion, focal, np.float32(reach))
        hessian, gradient, squares, weight, overlap = sums
        step = -np.linalg.solve(hessian + np.eye(6) * (DAMPING * max(weight, 1.0)), gradient)
        target_from_source = rigid.exp(step) @ target_from_source
        if np.abs(step).max() < CONVERGED:
            break
    residual = float(np.sqrt(squares / max(weight, 1e-9)))
    noise = max(residual, NOISE_FLOOR_M)
    return IcpResult(target_from_source, hessian / (POINTS_PER_MEASUREMENT * noise**2), overlap, residual)


def _normals(points: Float[np.ndarray, "height width 3"]) -> Float[np.ndarray, "height width 3"]:
    """Return unit normals towards the camera by central differences; zero at depth steps and the rim."""
    normals = np.zeros_like(points)
    across = points[1:-1, 2:] - points[1:-1, :-2]
    down = points[2:, 1:-1] - points[:-2, 1:-1]
    z = points[..., 2]
    neighbours = np.stack([z[1:-1, 2:], z[1:-1, :-2], z[2:, 1:-1], z[:-2, 1:-1], z[1:-1, 1:-1]])
    smooth = (neighbours.min(0) > 0) & (
        np.ptp(neighbours, axis=0) < NORMAL_JUMP * np.maximum(neighbours[-1], NORMAL_JUMP_DEPTH_M)
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
    """Sum the normal equations of one Gauss-Newton step; twist acts on the target's side."""
    hessian, gradient = np.zeros((6, 6)), np.zeros(6)
    squares, total, met, seen = 0.0, 0.0, 0.0, 0.0
    height, width = target_points.shape[:2]
    row = np.zeros(6)
    for i in range(source_points.shape[0]):
        for j in range(source_points.shape[1]):
            normal_source = source_normals[i, j]
            if normal_source[0] == 0 and normal_source[1] == 0 and normal_source[2] == 0:
                continue
            p = rotation @ source_points[i, j] + translation
            if p[2] < NEAREST_M:
                continue
            x = int(np.floor(p[0] / p[2] * focal[0] + focal[2]))
            y = int(np.floor(p[1] / p[2] * focal[1] + focal[3]))
            if x < 0 or y < 0 or x >= width or y >= height:
                continue
            n, q = target_normals[y, x], target_points[y, x]
            if n[0] == 0 and n[1] == 0 and n[2] == 0:
                continue
            seen += 1.0
            d = p - q
            turned = rotation @ normal_source
            cosine = turned[0] * n[0] + turned[1] * n[1] + turned[2] * n[2]
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
            total += weight
            met += 1.0
    return hessian, gradient, squares, total, met / max(seen, 1.0)
