"""Spatial encodings of fields: multi-resolution dense grids, or an MLP with positional encoding.

Both map points in the field's frame, meters, to ``channels`` channels.
"""

import math
from collections.abc import Sequence
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

GRID_STD = 0.01
"""standard deviation of untrained grids"""


class DenseGrid(nn.Module):
    """Trilinear interpolation in dense grids of several resolutions; their channels are concatenated."""

    low: Float[Tensor, "3"]
    extents: Float[Tensor, "level 3"]

    def __init__(
        self,
        low_m: Sequence[float],
        high_m: Sequence[float],
        voxel_m: Sequence[float],
        channels: int,
        initial: float = GRID_STD,
    ):
        super().__init__()
        low, high = torch.tensor(low_m, dtype=torch.float32), torch.tensor(high_m, dtype=torch.float32)
        self.register_buffer("low", low, persistent=False)
        self.levels, extents = nn.ParameterList(), []
        for voxel in voxel_m:
            nodes = ((high - low) / voxel).ceil().int() + 1
            extents.append((nodes - 1) * voxel)
            self.levels.append(nn.Parameter(torch.randn(1, channels, *nodes.flip(0).tolist()) * initial))
        self.register_buffer("extents", torch.stack(extents), persistent=False)
        self.channels = channels * len(voxel_m)

    def forward(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, "point channel"]:
        """Interpolate at points in the field's frame, meters; outside the box the border values hold."""
        found = []
        for extent, level in zip(self.extents, self.levels, strict=True):
            place = ((points - self.low) / extent * 2 - 1).view(1, 1, 1, -1, 3)
            read = functional.grid_sample(level, place, padding_mode="border", align_corners=True)
            found.append(read.view(level.shape[1], -1))
        return torch.cat(found).t()


class PositionalMLP(nn.Module):
    """An MLP on the positional encoding of points, from the box's size to 2 ``finest_m`` (ATS, Sec. 3.1)."""

    middle: Float[Tensor, "3"]
    frequency: Float[Tensor, "octave"]

    def __init__(self, low_m: Sequence[float], high_m: Sequence[float], finest_m: float, width: int):
        super().__init__()
        low, high = torch.tensor(low_m, dtype=torch.float32), torch.tensor(high_m, dtype=torch.float32)
        self.register_buffer("middle", (low + high) / 2, persistent=False)
        longest = float((high - low).max())
        octaves = max(1, math.ceil(math.log2(longest / finest_m)))
        self.register_buffer("frequency", math.pi / longest * 2 ** torch.arange(octaves), persistent=False)
        sizes = [3 + 6 * octaves] + [width] * 3
        self.network = nn.Sequential(
            *(part for pair in pairwise(sizes) for part in (nn.Linear(*pair), nn.ReLU()))
        )
        self.channels = width

    def forward(self, points: Float[Tensor, "point 3"]) -> Float[Tensor, "point channel"]:
        """Return the MLP's features of points, meters."""
        place = points - self.middle
        phase = (place[:, :, None] * self.frequency).flatten(1)
        return self.network(torch.cat([place, phase.sin(), phase.cos()], dim=1))
