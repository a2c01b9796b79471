"""Goals and paths as channels of diffusion: goals with power-transformed length, paths as strides; or both as
positions, as in the paper.

An animal rests most of the time. In positions, rest is as uncertain as a walk, and residual sampling noise
makes a path tremble. In strides rest is zero, the square root separates it from the slowest walk, and an
additional channel states whether the animal moves.
"""

from typing import overload

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pipeline.behavior.config import Encoding
from pipeline.behavior.trajectories import RATE_HZ

PATH_CHANNELS = 4
"""channels of a stride: velocity (m/s) with square-rooted length, then 1 in motion, -1 at rest"""
REST_SPEED_M_S = 0.05
"""speed below which an animal rests: it breathes, and reconstructions err"""
REST_DAMPING = 0.6
"""factor on sampled strides at rest, the rest being noise; on held-out homes, animals then move as much as
recorded ones at rest"""
VELOCITY_POWER, GOAL_LENGTH_POWER = 0.5, 0.7
"""powers of the lengths of velocities and goals (0.7 better than 0.5 and 1 on a held-out home)"""
PATH_CHANNELS_OF: dict[Encoding, int] = {"strides": PATH_CHANNELS, "positions": 3}
"""channels of a path by encoding"""
GOAL_POWER_OF: dict[Encoding, float] = {"strides": GOAL_LENGTH_POWER, "positions": 1.0}
"""power of the lengths of goals by encoding"""
GOAL_TOLERANCE_M, GOAL_TOLERANCE_SHARE = 0.1, 0.25
"""tolerance of a path's end from its goal, meters, or relative to the goal's distance if that is more"""
MIN_SQUARED_M2 = 1e-12
"""lower bound of squared lengths, square meters: shorter vectors have no direction"""


@overload
def with_powered_length(
    way: Float[np.ndarray, "*batch 3"], power: float
) -> Float[np.ndarray, "*batch 3"]: ...
@overload
def with_powered_length(way: Float[Tensor, "*batch 3"], power: float) -> Float[Tensor, "*batch 3"]: ...
def with_powered_length(
    way: Float[np.ndarray, "*batch 3"] | Float[Tensor, "*batch 3"], power: float
) -> Float[np.ndarray, "*batch 3"] | Float[Tensor, "*batch 3"]:
    """Raise the lengths of vectors to a power, which the inverse power undoes; zero vectors stay zero."""
    # the lower bound, not a summand: the ONNX exporter drops summands as small as this one
    return way * (way**2).sum(-1)[..., None].clip(min=MIN_SQUARED_M2) ** ((power - 1) / 2)


def velocity_channels_from_path(
    path: Float[Tensor, "*batch frame 3"], start: Float[Tensor, "*batch 3"], rate_hz: float = RATE_HZ
) -> Float[Tensor, "*batch frame 4"]:
    """Return the strides along a path in meters that begins a frame after ``start``."""
    before = torch.cat([start[..., None, :], path[..., :-1, :]], dim=-2)
    velocity = (path - before) * rate_hz
    moves = torch.where((velocity**2).sum(-1, keepdim=True) > REST_SPEED_M_S**2, 1.0, -1.0)
    return torch.cat([with_powered_length(velocity, VELOCITY_POWER), moves.to(velocity)], dim=-1)


def path_from_velocity_channels(
    strides: Float[np.ndarray, "*batch frame 4"],
    start: Float[np.ndarray, "*batch 3"],
    rate_hz: float = RATE_HZ,
) -> Float[np.ndarray, "*batch frame 3"]:
    """Integrate sampled strides to a path in meters."""
    root = strides[..., :3] * np.where(strides[..., 3:] > 0, 1.0, REST_DAMPING)
    return start[..., None, :] + (with_powered_length(root, 1 / VELOCITY_POWER) / rate_hz).cumsum(-2)


def expected_steps(
    strides: Float[Tensor, "batch frame 4"], rate_hz: float = RATE_HZ
) -> Float[Tensor, "batch frame 3"]:
    """Return the displacement per frame, meters, of unscaled strides."""
    root = strides[..., :3] * torch.where(strides[..., 3:] > 0, 1.0, REST_DAMPING)
    return with_powered_length(root, 1 / VELOCITY_POWER) / rate_hz


def warped_path(
    strides: Float[np.ndarray, "*batch frame 4"],
    start: Float[np.ndarray, "*batch 3"],
    path: Float[np.ndarray, "*batch frame 3"],
    rate_hz: float = RATE_HZ,
) -> Float[np.ndarray, "*batch frame 4"]:
    """Return strides that follow another path, meters in the same frame, with unchanged motion flags."""
    velocity = np.diff(path, axis=-2, prepend=start[..., None, :]) * rate_hz
    root = with_powered_length(velocity, VELOCITY_POWER) / np.where(strides[..., 3:] > 0, 1.0, REST_DAMPING)
    return np.concatenate([root, strides[..., 3:]], axis=-1)


def goal_error(
    path: Float[np.ndarray, "*batch frame 3"],
    start: Float[np.ndarray, "*batch 3"],
    goal: Float[np.ndarray, "*batch 3"],
) -> Float[np.ndarray, "*batch"]:
    """Return the distance of paths' ends from the goals relative to the tolerance; more than 1 is a miss."""
    reach = np.maximum(GOAL_TOLERANCE_M, GOAL_TOLERANCE_SHARE * np.linalg.norm(goal - start, axis=-1))
    return np.linalg.norm(path[..., -1, :] - goal, axis=-1) / reach


def snapped_to_goal(
    path: Float[np.ndarray, "*batch frame 3"],
    start: Float[np.ndarray, "*batch 3"],
    goal: Float[np.ndarray, "*batch 3"],
    pull: float,
) -> Float[np.ndarray, "*batch frame 3"]:
    """Warp a path towards its goal: to end there (``pull`` 1), unchanged (0), or between.

    Each stride is shifted in proportion to its length, and by at most its length: rest is preserved, and a
    path that hardly moves does not reach the goal.
    """
    traveled = np.linalg.norm(np.diff(path, axis=-2, prepend=start[..., None, :]), axis=-1).cumsum(-1)
    missing = goal - path[..., -1, :]
    longest = np.maximum(np.linalg.norm(missing, axis=-1, keepdims=True), traveled[..., -1:])
    return path + missing[..., None, :] * (pull * traveled / np.maximum(longest, MIN_SQUARED_M2))[..., None]
