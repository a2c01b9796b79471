"""Reading the map at noisy points, as the released code does: a goal at where it may lie, a path at each of
its waypoints.

A variant beside `goal_denoiser.MapAttention`, which looks where it wants to. Points are read where they are
expected, given the noisy sample and nothing else: at the noisiest steps all are near the animal.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor, nn

from pipeline.behavior.denoisers import ControlUNet
from pipeline.behavior.diffusion import STANDARD, Schedule
from pipeline.behavior.path_encoding import (
    GOAL_LENGTH_POWER,
    PATH_CHANNELS,
    expected_steps,
    with_powered_length,
)
from pipeline.behavior.perception import GRID_CELL_M, GRID_SHAPE, MAP_KEY_CHANNELS
from pipeline.behavior.trajectories import RATE_HZ

HALF_M = GRID_SHAPE[0] * GRID_CELL_M / 2
"""from the middle of a map to its edge"""
READ = 2 * MAP_KEY_CHANNELS
"""channels of a map"""


def read_at(
    maps: Float[Tensor, "batch member map"], points: Float[Tensor, "batch point 3"]
) -> Float[Tensor, "batch member channel point"]:
    """Return what maps say, bilinear, at points in metres of the ego frame; zeros beyond the edge."""
    cells = math.isqrt(int(maps.shape[-1]) // READ)
    chart = maps.flatten(0, 1).unflatten(1, (READ, cells, cells))
    where = (points[:, None, :, None, ::2] / HALF_M).expand(-1, maps.shape[1], -1, -1, -1).flatten(0, 1)
    read = nn.functional.grid_sample(chart, where, align_corners=False)[..., 0]
    return read.unflatten(0, (-1, maps.shape[1]))


class MapAtGoal(nn.Module):
    """The map where a noisy goal is expected; called as `MapAttention` is."""

    NUMBERS = READ
    goal_std: Tensor

    def __init__(self):
        super().__init__()
        self.register_buffer("goal_std", torch.ones(3))

    def forward(
        self,
        mean: Float[Tensor, "draw 3"],
        variance: Float[Tensor, "draw 1"],
        code: Float[Tensor, "member draw code"],
        maps: Float[Tensor, "batch member map"],
        draws: int,
    ) -> Float[Tensor, "member draw 16"]:
        """Return the map's channels there."""
        del code
        goal = with_powered_length(mean / (1 + variance) * self.goal_std, 1 / GOAL_LENGTH_POWER)
        return read_at(maps, goal.unflatten(0, (-1, draws))).permute(1, 0, 3, 2).flatten(1, 2)


class WaypointUNet(ControlUNet):
    """A `ControlUNet` of velocity channels that reads the maps of all members at each noisy waypoint."""

    share: Tensor
    velocity_std: Tensor

    def __init__(
        self,
        ensemble_size: int,
        map_cells: int,
        frames: int,
        control: int,
        condition: int,
        width: int = 32,
        multipliers: tuple[int, ...] = (1, 2, 4),
        schedule: Schedule = STANDARD,
        rate_hz: float = RATE_HZ,
    ):
        super().__init__(PATH_CHANNELS, control, condition, width, multipliers, schedule)
        self.ensemble_size, self.map_numbers = ensemble_size, READ * map_cells**2
        self.rate_hz = rate_hz
        self.main.enter = nn.Conv1d(PATH_CHANNELS + ensemble_size * READ, self.main.block_widths[0], 1)
        self.register_buffer("share", torch.from_numpy(schedule.alpha_bar).float().sqrt(), persistent=False)
        self.register_buffer("velocity_std", torch.ones(frames, PATH_CHANNELS))

    def unet_input(
        self,
        x: Float[Tensor, "batch 4 frame"],
        t: Float[Tensor, "batch"],
        condition: Float[Tensor, "batch condition"],
    ) -> Float[Tensor, "batch channel frame"]:
        """Return the noisy strides and, beside each, what the maps say where it is expected to lead."""
        maps = condition[:, : self.ensemble_size * self.map_numbers].unflatten(1, (self.ensemble_size, -1))
        return torch.cat([x, read_at(maps, self.waypoints(x, t)).flatten(1, 2)], dim=1)

    def waypoints(
        self, x: Float[Tensor, "batch 4 frame"], t: Float[Tensor, "batch"]
    ) -> Float[Tensor, "batch frame 3"]:
        """Return where noisy strides are expected to lead, metres from the animal."""
        strides = (self.share[t.long()][:, None, None] * x).transpose(-1, -2) * self.velocity_std
        return expected_steps(strides, self.rate_hz).cumsum(1)
