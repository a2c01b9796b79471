"""A sparse, robust pose graph over relative poses with full 6x6 information.

Collect `RelativePose`s (odometry between neighbours, ICP between frames that see the same place) and call
`optimize_pose_graph`.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import scipy.sparse
import scipy.sparse.linalg
from jaxtyping import Float

from pipeline.geometry import rigid

CAUCHY_SCALE = 3.0
"""Mahalanobis distance at which an edge's weight is halved."""
FIXED_PRECISION, FREE_PRECISION = 1e12, 1e-6
"""Prior precision of the first pose, which stays, and of the others, which keeps unconnected ones
solvable."""
CONVERGED = 1e-6
"""Steps below this (radians, metres) end the iteration."""


@dataclass(frozen=True)
class RelativePose:
    """A measured motion between two frames; the information weighs the twist (rotation vector, translation;
    first camera's frame)."""

    first: int
    second: int
    first_from_second: Float[np.ndarray, "4 4"]
    information: Float[np.ndarray, "6 6"]
    robust: bool = True
    """Whether the measurement may be an outlier (Cauchy's weight)."""


def optimize_pose_graph(
    world_from_camera: Float[np.ndarray, "frame 4 4"],
    edges: Sequence[RelativePose],
    *,
    iterations: int,
    chi: float = CAUCHY_SCALE,
) -> Float[np.ndarray, "frame 4 4"]:
    """Minimise the edges' squared Mahalanobis errors by Gauss-Newton, the first frame held.

    An edge's residual is log(measured_second_from_first @ current first_from_second), its robust weight
    Cauchy's with scale ``chi``. Rotation and translation Jacobians take the relative error as small, which
    odometry grants.
    """
    poses = np.array(world_from_camera, float)
    first = np.array([edge.first for edge in edges])
    second = np.array([edge.second for edge in edges])
    measured = np.stack([edge.first_from_second for edge in edges])
    information = np.stack([edge.information for edge in edges])
    robust = np.array([edge.robust for edge in edges])
    for _ in range(iterations):
        relative = rigid.inverse(poses[first]) @ poses[second]
        residual = rigid.log(relative @ rigid.inverse(measured))
        square = np.einsum("ei,eij,ej->e", residual, information, residual)
        weighted = information * np.where(robust, 1 / (1 + square / chi**2), 1.0)[:, None, None]
        step = _solve(len(poses), first, second, relative, residual, weighted)
        poses = poses @ rigid.exp(step)
        if np.abs(step).max() < CONVERGED:
            break
    return poses


def _solve(
    count: int,
    first: np.ndarray,
    second: np.ndarray,
    relative: np.ndarray,
    residual: np.ndarray,
    information: np.ndarray,
) -> Float[np.ndarray, "frame 6"]:
    """Solve one Gauss-Newton step for the poses' twists, each on its camera's side."""
    rotation, translation = relative[:, :3, :3], relative[:, :3, 3]
    j_first = -np.broadcast_to(np.eye(6), information.shape)
    # The adjoint carries the second camera's twist to the first camera's frame.
    j_second = np.zeros_like(information)
    j_second[:, :3, :3] = j_second[:, 3:, 3:] = rotation
    j_second[:, 3:, :3] = np.cross(translation[:, None, :], rotation.transpose(0, 2, 1)).transpose(0, 2, 1)
    rows, columns, blocks, gradient = [], [], [], np.zeros((count, 6))
    for index_a, j_a in ((first, j_first), (second, j_second)):
        weighted = j_a.transpose(0, 2, 1) @ information
        np.add.at(gradient, index_a, np.einsum("eij,ej->ei", weighted, residual))
        for index_b, j_b in ((first, j_first), (second, j_second)):
            blocks.append(weighted @ j_b)
            rows.append(index_a)
            columns.append(index_b)
    rows, columns, blocks = np.concatenate(rows), np.concatenate(columns), np.concatenate(blocks)
    inner = np.arange(6)
    at = (
        np.repeat(rows * 6, 6 * 6) + np.tile(np.repeat(inner, 6), len(rows)),
        np.repeat(columns * 6, 6 * 6) + np.tile(inner, 6 * len(rows)),
    )
    hessian = scipy.sparse.coo_matrix((blocks.reshape(-1), at), shape=(6 * count, 6 * count))
    held = scipy.sparse.diags(np.r_[np.full(6, FIXED_PRECISION), np.full(6 * (count - 1), FREE_PRECISION)])
    return -scipy.sparse.linalg.spsolve((hessian + held).tocsc(), gradient.reshape(-1)).reshape(count, 6)
