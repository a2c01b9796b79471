"""Sampling of the map at noisy goals and at each noisy waypoint of a path, as in the released code.

An alternative to `goal_denoiser.MapAttention`. The map is sampled at the expected clean point given the noisy
one alone: at the noisiest steps all are near the animal.
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

HALF_MAP_M = GRID_SHAPE[0] * GRID_CELL_M / 2
"""distance from the center of a map to its edge"""
MAP_CHANNELS = 2 * MAP_KEY_CHANNELS
"""channels of a map"""


def sample_maps(
    maps: Float[Tensor, "batch member map"], points: Float[Tensor, "batch point 3"]
) -> Float[Tensor, "batch member channel point"]:
    """Sample maps bilinearly at points in meters of the ego frame; zeros beyond the edge."""
    cells = math.isqrt(int(maps.shape[-1]) // MAP_CHANNELS)
    images = maps.flatten(0, 1).unflatten(1, (MAP_CHANNELS, cells, cells))
    where = (points[:, None, :, None, ::2] / HALF_MAP_M).expand(-1, maps.shape[1], -1, -1, -1).flatten(0, 1)
    read = nn.functional.grid_sample(images, where, align_corners=False)[..., 0]
    return read.unflatten(0, (-1, maps.shape[1]))


class MapAtGoal(nn.Module):
    """The map at the expected clean goal; same signature as `MapAttention`."""

    NUMBERS = MAP_CHANNELS
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
        """Return the map's channels at the expected goals."""
        del code
        goal = with_powered_length(mean / (1 + variance) * self.goal_std, 1 / GOAL_LENGTH_POWER)
        return sample_maps(maps, goal.unflatten(0, (-1, draws))).permute(1, 0, 3, 2).flatten(1, 2)


class WaypointUNet(ControlUNet):
    """A `ControlUNet` of paths that also reads all members' maps at each expected waypoint."""

    sqrt_alpha_bar: Tensor
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
        self.ensemble_size, self.map_numbers = ensemble_size, MAP_CHANNELS * map_cells**2
        self.rate_hz = rate_hz
        channels = PATH_CHANNELS + ensemble_size * MAP_CHANNELS
        self.main.enter = nn.Conv1d(channels, self.main.block_widths[0], 1)
        sqrt_alpha_bar = torch.from_numpy(schedule.alpha_bar).float().sqrt()
        self.register_buffer("sqrt_alpha_bar", sqrt_alpha_bar, persistent=False)
        self.register_buffer("velocity_std", torch.ones(frames, PATH_CHANNELS))

    def unet_input(
        self,
        x: Float[Tensor, "batch 4 frame"],
        t: Float[Tensor, "batch"],
        condition: Float[Tensor, "batch condition"],
    ) -> Float[Tensor, "batch channel frame"]:
        """Return the noisy strides and the maps' channels at the expected waypoints, concatenated."""
        maps = condition[:, : self.ensemble_size * self.map_numbers].unflatten(1, (self.ensemble_size, -1))
        return torch.cat([x, sample_maps(maps, self.waypoints(x, t)).flatten(1, 2)], dim=1)

    def waypoints(
        self, x: Float[Tensor, "batch 4 frame"], t: Float[Tensor, "batch"]
    ) -> Float[Tensor, "batch frame 3"]:
        """Return the expected waypoints given noisy strides, meters from the animal."""
        strides = (self.sqrt_alpha_bar[t.long()][:, None, None] * x).transpose(-1, -2) * self.velocity_std
        return expected_steps(strides, self.rate_hz).cumsum(1)
