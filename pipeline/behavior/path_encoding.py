"""Goals and paths as the numbers that are diffused: ways by a power of their length, paths by their strides.

An animal rests most of the time. In positions, rest is as uncertain as a walk, and the noise that sampling
leaves makes a path tremble. In strides rest is zero, the root separates it from the slowest walk, and a
channel of its own states whether the animal moves.
"""

from typing import overload

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pipeline.behavior.trajectories import RATE_HZ

PATH_CHANNELS = 4
"""numbers of a stride: the root of the velocity (of m/s) along x, y, z, and 1 where the animal moves, -1
where it stays"""
REST_SPEED_M_S = 0.05
"""speed below which an animal stays: it breathes, and reconstructions err"""
REST_DAMPING = 0.6
"""share of a sampled stride that is left of it where the animal stays; the rest is noise (measured on homes
kept from training, where what is left moves as much as resting animals do)"""
VELOCITY_POWER, GOAL_LENGTH_POWER = 0.5, 0.7
"""powers of lengths: of velocities, and of the ways to goals (0.7 measured ahead of 0.5 and 1 on a home kept
from training)"""
GOAL_TOLERANCE_M, GOAL_TOLERANCE_SHARE = 0.1, 0.25
"""how far from its goal, at most, a path ends that gets there: in metres, or as a share of the way where that
is more"""
MIN_SQUARED_M2 = 1e-12
"""square of a length, in square metres, that has no direction"""


@overload
def with_powered_length(
    way: Float[np.ndarray, "*batch 3"], power: float
) -> Float[np.ndarray, "*batch 3"]: ...
@overload
def with_powered_length(way: Float[Tensor, "*batch 3"], power: float) -> Float[Tensor, "*batch 3"]: ...
def with_powered_length(
    way: Float[np.ndarray, "*batch 3"] | Float[Tensor, "*batch 3"], power: float
) -> Float[np.ndarray, "*batch 3"] | Float[Tensor, "*batch 3"]:
    """Return vectors of the same direction, whose lengths are raised to a power; the inverse
    power undoes it. A vector of length 0 stays one.
    """
    # the lower bound, not a summand: the ONNX exporter drops summands as small as this one
    return way * (way**2).sum(-1)[..., None].clip(min=MIN_SQUARED_M2) ** ((power - 1) / 2)


def velocity_channels_from_path(
    path: Float[Tensor, "*batch frame 3"], start: Float[Tensor, "*batch 3"], rate_hz: float = RATE_HZ
) -> Float[Tensor, "*batch frame 4"]:
    """Return the strides along a path in metres that begins a frame after ``start``."""
    before = torch.cat([start[..., None, :], path[..., :-1, :]], dim=-2)
    velocity = (path - before) * rate_hz
    moves = torch.where((velocity**2).sum(-1, keepdim=True) > REST_SPEED_M_S**2, 1.0, -1.0)
    return torch.cat([with_powered_length(velocity, VELOCITY_POWER), moves.to(velocity)], dim=-1)


def path_from_velocity_channels(
    strides: Float[np.ndarray, "*batch frame 4"],
    start: Float[np.ndarray, "*batch 3"],
    rate_hz: float = RATE_HZ,
) -> Float[np.ndarray, "*batch frame 3"]:
    """Return the path in metres that sampled strides lead along."""
    root = strides[..., :3] * np.where(strides[..., 3:] > 0, 1.0, REST_DAMPING)
    return start[..., None, :] + (with_powered_length(root, 1 / VELOCITY_POWER) / rate_hz).cumsum(-2)


def expected_steps(
    strides: Float[Tensor, "batch frame 4"], rate_hz: float = RATE_HZ
) -> Float[Tensor, "batch frame 3"]:
    """Return how far the animal goes in each frame, metres, along strides in the units of the channels."""
    root = strides[..., :3] * torch.where(strides[..., 3:] > 0, 1.0, REST_DAMPING)
    return with_powered_length(root, 1 / VELOCITY_POWER) / rate_hz


def warped_path(
    strides: Float[np.ndarray, "*batch frame 4"],
    start: Float[np.ndarray, "*batch 3"],
    path: Float[np.ndarray, "*batch frame 3"],
    rate_hz: float = RATE_HZ,
) -> Float[np.ndarray, "*batch frame 4"]:
    """Return strides that lead along another path, metres in the same frame, as far as they move."""
    velocity = np.diff(path, axis=-2, prepend=start[..., None, :]) * rate_hz
    root = with_powered_length(velocity, VELOCITY_POWER) / np.where(strides[..., 3:] > 0, 1.0, REST_DAMPING)
    return np.concatenate([root, strides[..., 3:]], axis=-1)


def goal_error(
    path: Float[np.ndarray, "*batch frame 3"],
    start: Float[np.ndarray, "*batch 3"],
    goal: Float[np.ndarray, "*batch 3"],
) -> Float[np.ndarray, "*batch"]:
    """Return how far from their goals paths end, in parts of the tolerance: more than 1 is a miss."""
    reach = np.maximum(GOAL_TOLERANCE_M, GOAL_TOLERANCE_SHARE * np.linalg.norm(goal - start, axis=-1))
    return np.linalg.norm(path[..., -1, :] - goal, axis=-1) / reach


def snapped_to_goal(
    path: Float[np.ndarray, "*batch frame 3"],
    start: Float[np.ndarray, "*batch 3"],
    goal: Float[np.ndarray, "*batch 3"],
    pull: float,
) -> Float[np.ndarray, "*batch frame 3"]:
    """Bend a path so that it ends at its goal (``pull`` 1), where it likes (0), or between.

    Each stride is bent in proportion to its length and by no more than that: who stays, stays, and who hardly
    moves does not get there.
    """
    way = np.linalg.norm(np.diff(path, axis=-2, prepend=start[..., None, :]), axis=-1).cumsum(-1)
    missing = goal - path[..., -1, :]
    longest = np.maximum(np.linalg.norm(missing, axis=-1, keepdims=True), way[..., -1:])
    return path + missing[..., None, :] * (pull * way / np.maximum(longest, MIN_SQUARED_M2))[..., None]
