"""Relax camera poses against contacts and relative motions: one sparse, robust Gauss-Newton for maps and registration.

A contact says that a point seen by one camera touches a point seen by another camera, or a point of
the fixed map, along one direction. Point-to-plane, point-to-line and point-to-point terms are all
contacts. A relative motion is what odometry claims between two frames. Cost is linear in frames.
"""

from collections.abc import Callable
from dataclasses import dataclass, fields

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import sparse
from scipy.sparse.linalg import spsolve

from pipeline.space import rigid

MAP = -1
"""Stands for the fixed map in ``Contacts.second``; its points are in world axes."""


@dataclass(frozen=True)
class Contacts:
    """Pairs of points that should touch along ``direction``; ``points_*`` in the camera (or map) they belong to,
    metres.
    """

    first: Int[np.ndarray, "contact"]
    second: Int[np.ndarray, "contact"]
    points_first: Float[np.ndarray, "contact 3"]
    points_second: Float[np.ndarray, "contact 3"]
    direction_world: Float[np.ndarray, "contact 3"]
    sigma_m: Float[np.ndarray, "contact"]

    @staticmethod
    def join(*parts: "Contacts") -> "Contacts":
        """Stack sets of contacts."""
        return Contacts(**{field.name: np.concatenate([getattr(part, field.name) for part in parts]) for field in fields(Contacts)})


@dataclass(frozen=True)
class Relatives:
    """Relative motions with their standard deviations, as odometry gives them."""

    first: Int[np.ndarray, "edge"]
    second: Int[np.ndarray, "edge"]
    first_from_second: Float[np.ndarray, "edge 4 4"]
    sigma_rad: Float[np.ndarray, "edge"]
    sigma_m: Float[np.ndarray, "edge"]


@dataclass(frozen=True)
class Relaxed:
    """Relaxed poses, and the contacts of the last round with their residuals."""

    world_from_camera: Float[np.ndarray, "frame 4 4"]
    contacts: Contacts
    residual_m: Float[np.ndarray, "contact"]


def chain(
    timestamp_s: Float[np.ndarray, "frame"],
    odometry_from_camera: Float[np.ndarray, "frame 4 4"],
    *,
    drift_rad_s: float,
    drift_m_s: float,
    floor_m: float = 0.001,
) -> Relatives:
    """Turn odometry into one relative motion per neighbouring pair; the drift grows with the time between."""
    first = np.arange(len(timestamp_s) - 1)
    gap_s = np.maximum(np.diff(timestamp_s), 1e-3)
    first_from_second = rigid.inverse(odometry_from_camera[:-1]) @ odometry_from_camera[1:]
    return Relatives(first, first + 1, first_from_second, drift_rad_s * gap_s + floor_m, drift_m_s * gap_s + floor_m)


def relax(
    world_from_camera: Float[np.ndarray, "frame 4 4"],
    find: Callable[[Float[np.ndarray, "frame 4 4"], float], Contacts],
    relatives: Relatives | None,
    *,
    reach_m: tuple[float, ...],
    held: Bool[np.ndarray, "frame"] | None = None,
) -> Relaxed:
    """Minimise contacts (Geman-McClure, width ``reach_m`` of each round) and relative motions over all poses at once.

    Each round finds the contacts anew within its reach and takes one Gauss-Newton step on the
    right-hand twist of each camera. Held frames stay where they are.
    """
    poses = np.array(world_from_camera, float)
    free = np.ones(len(poses), bool) if held is None else ~held
    for reach in reach_m:
        contacts = find(poses, reach)
        poses = poses @ rigid.exp(_solve(*_normal_equations(poses, contacts, relatives, reach), free))
    contacts = find(poses, reach_m[-1])
    return Relaxed(poses, contacts, residuals(poses, contacts))


def spread(
    world_from_camera: Float[np.ndarray, "frame 4 4"], contacts: Contacts, relatives: Relatives, reach_m: float
) -> Float[np.ndarray, "frame 6 6"]:
    """Return the marginal covariance of each camera's right-hand twist (rotation in radians, translation in metres).

    Inverse of the Gauss-Newton matrix; contacts must touch the map and motions join neighbours, so that it is block
    tridiagonal and its diagonal blocks follow from one pass forth and one back.
    """
    normal, _ = _normal_equations(world_from_camera, contacts, relatives, reach_m)
    blocks = sparse.bsr_array(normal, blocksize=(6, 6))
    row = np.repeat(np.arange(len(world_from_camera)), np.diff(blocks.indptr))
    assert (np.abs(row - blocks.indices) <= 1).all(), "contacts between cameras"
    own, next_to = np.zeros((2, len(world_from_camera), 6, 6))
    own[row[row == blocks.indices]] = blocks.data[row == blocks.indices]
    next_to[row[row + 1 == blocks.indices]] = blocks.data[row + 1 == blocks.indices]
    own = own + 1e-9 * np.eye(6)
    past, future = own.copy(), own.copy()
    for frame in range(1, len(own)):
        past[frame] -= next_to[frame - 1].T @ np.linalg.solve(past[frame - 1], next_to[frame - 1])
        back = len(own) - 1 - frame
        future[back] -= next_to[back] @ np.linalg.solve(future[back + 1], next_to[back].T)
    return np.linalg.inv(past + future - own)


def residuals(world_from_camera: Float[np.ndarray, "frame 4 4"], contacts: Contacts) -> Float[np.ndarray, "contact"]:
    """Return the signed gap of each contact along its direction in metres."""
    gap = _world(world_from_camera, contacts.first, contacts.points_first) - _world(
        world_from_camera, contacts.second, contacts.points_second
    )
    return np.einsum("ci,ci->c", gap, contacts.direction_world)


def _normal_equations(poses, contacts, relatives, reach):
    """Return matrix and gradient of one Gauss-Newton step."""
    jacobian, residual = _contact_rows(poses, contacts)
    robust = (reach**2 / (reach**2 + residual**2)) ** 2
    weight = robust / contacts.sigma_m**2
    normal = (jacobian.T @ sparse.diags_array(weight) @ jacobian).tocsc()
    gradient = jacobian.T @ (weight * residual)
    if relatives is not None and len(relatives.first):
        edge_jacobian, edge_residual = _edge_rows(poses, relatives)
        normal = normal + edge_jacobian.T @ edge_jacobian
        gradient = gradient + edge_jacobian.T @ edge_residual
    return normal, gradient


def _world(world_from_camera, index, points):
    moved = np.einsum("cij,cj->ci", world_from_camera[index, :3, :3], points) + world_from_camera[index, :3, 3]
    return np.where((index == MAP)[:, None], points, moved)


def _contact_rows(poses, contacts):
    residual = residuals(poses, contacts)
    blocks, columns, rows = [], [], []
    for index, points, sign in (
        (contacts.first, contacts.points_first, 1.0),
        (contacts.second, contacts.points_second, -1.0),
    ):
        row = np.flatnonzero(index != MAP)
        direction = np.einsum("cij,ci->cj", poses[index[row], :3, :3], contacts.direction_world[row])
        blocks.append(sign * np.concatenate([np.cross(points[row], direction), direction], axis=1))
        columns.append(index[row, None] * 6 + np.arange(6))
        rows.append(np.repeat(row[:, None], 6, axis=1))
    entries = [np.concatenate(part).ravel() for part in (blocks, rows, columns)]
    return sparse.csr_array((entries[0], (entries[1], entries[2])), shape=(len(residual), 6 * len(poses))), residual


def _edge_rows(poses, relatives):
    second_from_first = rigid.inverse(relatives.first_from_second)
    error = second_from_first @ rigid.inverse(poses[relatives.first]) @ poses[relatives.second]
    whiten = 1.0 / np.stack([relatives.sigma_rad] * 3 + [relatives.sigma_m] * 3, axis=-1)
    count = len(relatives.first)
    row = np.broadcast_to(np.arange(6 * count).reshape(count, 6, 1), (count, 6, 6))
    values = [
        -_adjoint(second_from_first) * whiten[..., None],
        np.broadcast_to(np.eye(6), (count, 6, 6)) * whiten[..., None],
    ]
    columns = [np.broadcast_to(index[:, None, None] * 6 + np.arange(6), (count, 6, 6)) for index in (relatives.first, relatives.second)]
    entries = (np.stack(values).ravel(), (np.stack([row, row]).ravel(), np.stack(columns).ravel()))
    return sparse.csr_array(entries, shape=(6 * count, 6 * len(poses))), (rigid.log(error) * whiten).ravel()


def _adjoint(a_from_b):
    """Return the 6x6 map of twists (rotation, translation) from frame b to frame a."""
    rotation, (x, y, z) = a_from_b[..., :3, :3], np.moveaxis(a_from_b[..., :3, 3], -1, 0)
    zero = np.zeros_like(x)
    hat = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(*x.shape, 3, 3)
    adjoint = np.zeros((*x.shape, 6, 6))
    adjoint[..., :3, :3] = adjoint[..., 3:, 3:] = rotation
    adjoint[..., 3:, :3] = hat @ rotation
    return adjoint


def _solve(normal, gradient, free):
    index = np.flatnonzero(np.repeat(free, 6))
    part = sparse.csc_array(normal)[index][:, index]
    damping = 1e-6 * part.diagonal() + 1e-6 * part.diagonal().mean() + 1e-12
    step = np.zeros(len(gradient))
    step[index] = spsolve((part + sparse.diags_array(damping)).tocsc(), -gradient[index])
    return step.reshape(-1, 6)
