"""Sparse, robust Gauss-Newton over camera poses, with correspondences and relative pose factors.

A correspondence pairs a point seen by one camera with a point of another camera or of the fixed map. Its
residual is their distance along one direction, so point-to-plane, point-to-line and point-to-point terms
share one form. A relative pose factor is the odometry between two frames. Run time is linear in frames.
"""

from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from typing import Protocol

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import sparse
from scipy.sparse.linalg import spsolve

from pipeline.geometry import rigid

MAP = -1
"""Index of the fixed map in ``Correspondences.second``; its points are in the world frame."""
MIN_SIGMA = 0.001
"""Standard deviation of odometry at zero time, radians and meters."""
MIN_STEP_S = 1e-3
"""Least time between frames, seconds."""
DAMPING = 1e-6
"""Levenberg damping relative to each diagonal element plus their mean: unobserved poses stay."""
CHI_DAMPING = 1e-3
"""Damping in `chi_squares`, relative to the mean diagonal: unconstrained directions do not count."""
MAX_ROWS = 2**19
"""Rows of the Jacobian per block, which bounds the memory of a step to half a gigabyte."""
MEDIAN_CHI_SQUARE = 5.348
"""Median of the chi-square distribution with six degrees of freedom."""
PRIOR_PRECISION = 1e-9
"""Added to the information, so that unconstrained frames have a finite covariance."""


@dataclass(frozen=True)
class Correspondences:
    """Points (meters, in the frame of their camera or the map) that coincide along ``direction_world``."""

    first: Int[np.ndarray, "match"]
    second: Int[np.ndarray, "match"]
    points_first: Float[np.ndarray, "match 3"]
    points_second: Float[np.ndarray, "match 3"]
    direction_world: Float[np.ndarray, "match 3"]
    sigma_m: Float[np.ndarray, "match"]

    @staticmethod
    def join(*parts: "Correspondences") -> "Correspondences":
        """Concatenate correspondences."""
        names = [field.name for field in fields(Correspondences)]
        return Correspondences(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))

    def selected(self, matches: slice | Int[np.ndarray, "some"]) -> "Correspondences":
        """Return a subset of the correspondences."""
        return Correspondences(*(getattr(self, field.name)[matches] for field in fields(self)))

    def inflated(self, factor: float) -> "Correspondences":
        """Multiply the standard deviations."""
        return replace(self, sigma_m=factor * self.sigma_m)


@dataclass(frozen=True)
class RelativePoseFactors:
    """Measured relative motions ``first_from_second`` with their (isotropic) standard deviations."""

    first: Int[np.ndarray, "edge"]
    second: Int[np.ndarray, "edge"]
    first_from_second: Float[np.ndarray, "edge 4 4"]
    sigma_rad: Float[np.ndarray, "edge"]
    sigma_m: Float[np.ndarray, "edge"]

    def inflated(self, factor: float) -> "RelativePoseFactors":
        """Multiply the standard deviations."""
        return replace(self, sigma_rad=factor * self.sigma_rad, sigma_m=factor * self.sigma_m)

    def chi_squares(self, world_from_camera: Float[np.ndarray, "frame 4 4"]) -> Float[np.ndarray, "edge"]:
        """Return each factor's squared Mahalanobis error."""
        return (_edge_rows(world_from_camera, self)[1].reshape(-1, 6) ** 2).sum(1)


@dataclass(frozen=True)
class OptimizedPoses:
    """Optimized poses, and the correspondences of the last round with their residuals."""

    world_from_camera: Float[np.ndarray, "frame 4 4"]
    correspondences: Correspondences
    residual_m: Float[np.ndarray, "match"]


class PoseTerm(Protocol):
    """An additional cost term with latent variables of its own, such as points."""

    def normal_equations(
        self, world_from_camera: Float[np.ndarray, "frame 4 4"]
    ) -> tuple[sparse.csc_array, Float[np.ndarray, "parameter"]]:
        """Return matrix and gradient for the cameras' right-hand twists, own variables eliminated."""
        ...


def odometry_factors(
    timestamp_s: Float[np.ndarray, "frame"],
    odometry_from_camera: Float[np.ndarray, "frame 4 4"],
    *,
    drift_rad_s: float,
    drift_m_s: float,
) -> RelativePoseFactors:
    """Return one factor per consecutive pair; standard deviations grow with time."""
    first = np.arange(len(timestamp_s) - 1)
    gap_s = np.maximum(np.diff(timestamp_s), MIN_STEP_S)
    first_from_second = rigid.inverse(odometry_from_camera[:-1]) @ odometry_from_camera[1:]
    sigma_rad, sigma_m = (drift * gap_s + MIN_SIGMA for drift in (drift_rad_s, drift_m_s))
    return RelativePoseFactors(first, first + 1, first_from_second, sigma_rad, sigma_m)


def optimize_poses(
    world_from_camera: Float[np.ndarray, "frame 4 4"],
    find_correspondences: Callable[[Float[np.ndarray, "frame 4 4"], float], Correspondences],
    relative_poses: RelativePoseFactors | None,
    *,
    reach_m: tuple[float, ...],
    fixed: Bool[np.ndarray, "frame"] | None = None,
    term: PoseTerm | None = None,
) -> OptimizedPoses:
    """Minimize sum_c rho(r_c / sigma_c) + sum_e |log(e)|^2 over all poses, rho the Geman-McClure kernel.

    Each round recomputes the correspondences within its reach (meters, also the kernel's width) and takes one
    Gauss-Newton step on the right-hand twist of each camera. ``fixed`` poses stay; ``term`` is added.
    """
    poses = np.array(world_from_camera, float)
    free = np.ones(len(poses), bool) if fixed is None else ~fixed
    for reach in reach_m:
        correspondences = find_correspondences(poses, reach)
        normal, gradient = _normal_equations(poses, correspondences, relative_poses, reach)
        if term is not None:
            other_normal, other_gradient = term.normal_equations(poses)
            normal, gradient = normal + other_normal, gradient + other_gradient
        poses = poses @ rigid.exp(_solve(normal, gradient, free))
    correspondences = find_correspondences(poses, reach_m[-1])
    return OptimizedPoses(poses, correspondences, residuals(poses, correspondences))


def marginal_covariance(
    world_from_camera: Float[np.ndarray, "frame 4 4"],
    correspondences: Correspondences,
    relative_poses: RelativePoseFactors,
    reach_m: float,
) -> Float[np.ndarray, "frame 6 6"]:
    """Return the marginal covariance of each camera's right-hand twist (rotation, translation).

    These are diagonal blocks of the inverse Hessian. Correspondences must be with the map and factors between
    neighbors, so that the Hessian is block tridiagonal: one forward and one backward pass suffice.
    """
    normal, _ = _normal_equations(world_from_camera, correspondences, relative_poses, reach_m)
    blocks = sparse.bsr_array(normal, blocksize=(6, 6))
    row = np.repeat(np.arange(len(world_from_camera)), np.diff(blocks.indptr))
    assert (np.abs(row - blocks.indices) <= 1).all(), "correspondences link cameras that are not neighbors"
    diagonal, upper = np.zeros((2, len(world_from_camera), 6, 6))
    diagonal[row[row == blocks.indices]] = blocks.data[row == blocks.indices]
    upper[row[row + 1 == blocks.indices]] = blocks.data[row + 1 == blocks.indices]
    diagonal = diagonal + PRIOR_PRECISION * np.eye(6)
    forward, backward = diagonal.copy(), diagonal.copy()
    for frame in range(1, len(diagonal)):
        forward[frame] -= upper[frame - 1].T @ np.linalg.solve(forward[frame - 1], upper[frame - 1])
        back = len(diagonal) - 1 - frame
        backward[back] -= upper[back] @ np.linalg.solve(backward[back + 1], upper[back].T)
    return np.linalg.inv(forward + backward - diagonal)


def chi_squares(
    world_from_camera: Float[np.ndarray, "frame 4 4"],
    correspondences: Correspondences,
    group: Int[np.ndarray, "match"],
    reach_m: float,
) -> Float[np.ndarray, "group"]:
    """Return g^T H^-1 g of each group of correspondences, with respect to its first camera's pose.

    Chi-square distributed with six degrees of freedom if sigmas are correct and errors independent.
    """
    residual = residuals(world_from_camera, correspondences)
    weight = (reach_m**2 / (reach_m**2 + residual**2)) ** 2 / correspondences.sigma_m**2
    rotation = world_from_camera[correspondences.first, :3, :3]
    direction = np.einsum("cij,ci->cj", rotation, correspondences.direction_world)
    rows = np.concatenate([np.cross(correspondences.points_first, direction), direction], axis=1)
    normal, gradient = np.zeros((group.max() + 1, 6, 6)), np.zeros((group.max() + 1, 6))
    np.add.at(normal, group, np.einsum("c,ci,cj->cij", weight, rows, rows))
    np.add.at(gradient, group, rows * (weight * residual)[:, None])
    damping = CHI_DAMPING * np.trace(normal, axis1=1, axis2=2) / 6 + np.finfo(float).tiny
    step = np.linalg.solve(normal + damping[:, None, None] * np.eye(6), gradient[..., None])[..., 0]
    return (step * gradient).sum(1)


def variance_factor(chi_squares: Float[np.ndarray, "group"]) -> float:
    """Return the ratio of actual to assumed variance, from chi-squares of six degrees of freedom."""
    return float(np.median(chi_squares)) / MEDIAN_CHI_SQUARE


def residuals(
    world_from_camera: Float[np.ndarray, "frame 4 4"], correspondences: Correspondences
) -> Float[np.ndarray, "match"]:
    """Return the signed distance of each correspondence along its direction, meters."""
    first = _world(world_from_camera, correspondences.first, correspondences.points_first)
    second = _world(world_from_camera, correspondences.second, correspondences.points_second)
    return np.einsum("ci,ci->c", first - second, correspondences.direction_world)


def _normal_equations(poses, correspondences, relative_poses, reach):
    """Return the matrix and gradient of one Gauss-Newton step."""
    normal, gradient = sparse.csc_array((6 * len(poses),) * 2), np.zeros(6 * len(poses))
    for start in range(0, len(correspondences.first), MAX_ROWS):
        part = correspondences.selected(slice(start, start + MAX_ROWS))
        jacobian, residual = _correspondence_rows(poses, part)
        weight = (reach**2 / (reach**2 + residual**2)) ** 2 / part.sigma_m**2
        normal = normal + (jacobian.T @ sparse.diags_array(weight) @ jacobian).tocsc()
        gradient = gradient + jacobian.T @ (weight * residual)
    if relative_poses is not None and len(relative_poses.first):
        edge_jacobian, edge_residual = _edge_rows(poses, relative_poses)
        normal = normal + edge_jacobian.T @ edge_jacobian
        gradient = gradient + edge_jacobian.T @ edge_residual
    return normal, gradient


def _world(world_from_camera, index, points):
    pose = world_from_camera[index]
    moved = np.einsum("cij,cj->ci", pose[:, :3, :3], points) + pose[:, :3, 3]
    return np.where((index == MAP)[:, None], points, moved)


def _correspondence_rows(poses, correspondences):
    residual = residuals(poses, correspondences)
    blocks, columns, rows = [], [], []
    for index, points, sign in (
        (correspondences.first, correspondences.points_first, 1.0),
        (correspondences.second, correspondences.points_second, -1.0),
    ):
        row = np.flatnonzero(index != MAP)
        direction = np.einsum("cij,ci->cj", poses[index[row], :3, :3], correspondences.direction_world[row])
        blocks.append(sign * np.concatenate([np.cross(points[row], direction), direction], axis=1))
        columns.append(index[row, None] * 6 + np.arange(6))
        rows.append(np.repeat(row[:, None], 6, axis=1))
    values, rows, columns = (np.concatenate(part).ravel() for part in (blocks, rows, columns))
    return sparse.csr_array((values, (rows, columns)), shape=(len(residual), 6 * len(poses))), residual


def _edge_rows(poses, relative_poses):
    second_from_first = rigid.inverse(relative_poses.first_from_second)
    error = second_from_first @ rigid.inverse(poses[relative_poses.first]) @ poses[relative_poses.second]
    whiten = 1.0 / np.stack([relative_poses.sigma_rad] * 3 + [relative_poses.sigma_m] * 3, axis=-1)
    count = len(relative_poses.first)
    row = np.broadcast_to(np.arange(6 * count).reshape(count, 6, 1), (count, 6, 6))
    values = [
        -_adjoint(second_from_first) * whiten[..., None],
        np.broadcast_to(np.eye(6), (count, 6, 6)) * whiten[..., None],
    ]
    columns = [
        np.broadcast_to(index[:, None, None] * 6 + np.arange(6), (count, 6, 6))
        for index in (relative_poses.first, relative_poses.second)
    ]
    entries = (np.stack(values).ravel(), (np.stack([row, row]).ravel(), np.stack(columns).ravel()))
    return sparse.csr_array(entries, shape=(6 * count, 6 * len(poses))), (rigid.log(error) * whiten).ravel()


def _adjoint(a_from_b):
    """Return the 6x6 adjoint that maps twists (rotation, translation) from frame b to frame a."""
    rotation, (x, y, z) = a_from_b[..., :3, :3], np.moveaxis(a_from_b[..., :3, 3], -1, 0)
    zero = np.zeros_like(x)
    hat = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(*x.shape, 3, 3)
    adjoint = np.zeros((*x.shape, 6, 6))
    adjoint[..., :3, :3] = adjoint[..., 3:, 3:] = rotation
    adjoint[..., 3:, :3] = hat @ rotation
    return adjoint


def _solve(normal, gradient, free):
    index = np.flatnonzero(np.repeat(free, 6))
    if not len(index):
        return np.zeros((len(free), 6))
    part = sparse.csc_array(normal)[index][:, index]
    damping = DAMPING * (part.diagonal() + part.diagonal().mean()) + np.finfo(float).tiny
    step = np.zeros(len(gradient))
    step[index] = np.asarray(spsolve((part + sparse.diags_array(damping)).tocsc(), -gradient[index]))
    return step.reshape(-1, 6)
