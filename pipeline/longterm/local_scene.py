"""The scene around a short motion as its networks see it: points of its surface, and the signed distance on a
box of voxels.

`distance_fields` measures the distances once per clip; `read_distances` reads them at and around every frame
of a route, which shows where a route would lead through something and on which side it is free.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from pipeline.longterm.surroundings import MotionScene

VOXEL_M = 0.1
LOW_M = (-0.7, -0.4, -1.3)
SHAPE = (15, 10, 27)
"""The box in the clip's frame, +z from start to end."""
NEAREST_M, FARTHEST_M = -0.15, 0.45
"""Distances beyond these say nothing more."""
CLOSE_M = 0.15
"""What is nearer than this is in the way."""
PROBES_M = (
    (0, 0, 0), (0.15, 0, 0), (-0.15, 0, 0), (0.3, 0, 0), (-0.3, 0, 0), (0, 0.1, 0), (0, -0.1, 0),
    (0, 0, 0.15), (0, 0, -0.15),
)  # fmt: skip
"""Where distances are read: at the root, on both sides, above, beneath, ahead and behind."""
READ_CHANNELS = 2 * len(PROBES_M)
"""How many numbers `read_distances` gives per frame."""


@dataclass(frozen=True)
class LocalScene:
    """What networks may know of the scene around clips, in the clips' frames."""

    points: Float[Tensor, "clip point 3"]
    """on its surface"""
    field: Float[Tensor, "clip x y z"]
    """signed distance at the voxels of the box, metres, in half precision"""

    def __getitem__(self, index: Int[Tensor, "some"] | Int[np.ndarray, "some"]) -> "LocalScene":
        """Return what is around some of the clips."""
        return LocalScene(self.points[index], self.field[index])


def distance_fields(
    world_from_clip: Float[np.ndarray, "clip 4 4"],
    scene: Int[np.ndarray, "clip"],
    scenes: Sequence[MotionScene],
    most: int = 100,
) -> Float[Tensor, "clip x y z"]:
    """Measure the signed distance around clips, ``most`` at a time; without scenes it is 0."""
    axes = [low + VOXEL_M * torch.arange(count) for low, count in zip(LOW_M, SHAPE, strict=True)]
    voxels = torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1).reshape(-1, 3)
    frames = torch.from_numpy(np.asarray(world_from_clip)).float()
    field = torch.zeros(1, *SHAPE, dtype=torch.half)
    field = field.expand(len(frames), *SHAPE) if not scenes else field.repeat(len(frames), 1, 1, 1)
    for index, each in enumerate(scenes):
        for rows in torch.from_numpy(np.flatnonzero(np.asarray(scene) == index)).split(most):
            places = voxels @ frames[rows, :3, :3].transpose(1, 2) + frames[rows, None, :3, 3]
            field[rows] = each.distance.at(places).clamp(NEAREST_M, FARTHEST_M).unflatten(1, SHAPE).half()
    return field


def read_distances(
    field: Float[Tensor, "clip x y z"], route: Float[Tensor, "clip frame 3"]
) -> Float[Tensor, "clip frame read"]:
    """Read the distances around every frame of a route, and how much too near each is."""
    places = route[:, :, None] + torch.tensor(PROBES_M, dtype=route.dtype, device=route.device)
    last = VOXEL_M * (torch.tensor(SHAPE, dtype=route.dtype, device=route.device) - 1)
    grid = 2 * (places - torch.tensor(LOW_M, dtype=route.dtype, device=route.device)) / last - 1
    grid = grid.flip(-1)[:, None]  # grid_sample counts the last axis first
    values = field.to(route)[:, None]
    read = functional.grid_sample(values, grid, padding_mode="border", align_corners=True)[:, 0, 0]
    return torch.cat([4 * read, 10 * (CLOSE_M - read).clamp_min(0)], dim=-1)
