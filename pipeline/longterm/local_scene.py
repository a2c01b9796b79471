"""The scene around a clip as network input: surface points, and a signed distance field on a voxel box.

`distance_fields` samples the field once per clip; `read_distances` reads it at probes around every frame of a
route, so that a network sees where the route collides and on which side there is free space.
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
CLIPS_AT_ONCE = 100
"""Clips around which distances are sampled at once; bounds the memory."""
MIN_DISTANCE_M, MAX_DISTANCE_M = -0.15, 0.45
"""Signed distances are truncated to this range."""
CLEARANCE_M = 0.15
"""A probe closer to the scene than this is penalized by a channel of its own."""
PROBES_M = (
    (0, 0, 0), (0.15, 0, 0), (-0.15, 0, 0), (0.3, 0, 0), (-0.3, 0, 0), (0, 0.1, 0), (0, -0.1, 0),
    (0, 0, 0.15), (0, 0, -0.15),
)  # fmt: skip
"""Offsets of the probes from the root: none, to both sides, above, below, ahead and behind."""
READ_CHANNELS = 2 * len(PROBES_M)
"""Channels of `read_distances` per frame."""


@dataclass(frozen=True)
class LocalScene:
    """The scene around clips as the networks see it, in the clips' frames."""

    points: Float[Tensor, "clip point 3"]
    """on the scene's surface"""
    field: Float[Tensor, "clip x y z"]
    """signed distance at the voxels of the box, meters, in half precision"""

    def __getitem__(self, index: Int[Tensor, "some"] | Int[np.ndarray, "some"]) -> "LocalScene":
        """Return the surroundings of some of the clips."""
        return LocalScene(self.points[index], self.field[index])


def distance_fields(
    world_from_clip: Float[np.ndarray, "clip 4 4"],
    scene: Int[np.ndarray, "clip"],
    scenes: Sequence[MotionScene],
) -> Float[Tensor, "clip x y z"]:
    """Sample the signed distance around clips; 0 without scenes."""
    axes = [low + VOXEL_M * torch.arange(count) for low, count in zip(LOW_M, SHAPE, strict=True)]
    voxels = torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1).reshape(-1, 3)
    frames = torch.from_numpy(np.asarray(world_from_clip)).float()
    field = torch.zeros(len(frames), *SHAPE, dtype=torch.half)
    for index, each in enumerate(scenes):
        for rows in torch.from_numpy(np.flatnonzero(np.asarray(scene) == index)).split(CLIPS_AT_ONCE):
            points = voxels @ frames[rows, :3, :3].transpose(1, 2) + frames[rows, None, :3, 3]
            distance = each.distance.at(points).clamp(MIN_DISTANCE_M, MAX_DISTANCE_M)
            field[rows] = distance.unflatten(1, SHAPE).half()
    return field


def read_distances(
    field: Float[Tensor, "clip x y z"], route: Float[Tensor, "clip frame 3"]
) -> Float[Tensor, "clip frame read"]:
    """Return the signed distance at the probes of every frame, and the clearance each lacks, both scaled."""
    probes = route[:, :, None] + route.new_tensor(PROBES_M)
    last = VOXEL_M * (route.new_tensor(SHAPE) - 1)
    grid = (2 * (probes - route.new_tensor(LOW_M)) / last - 1).flip(-1)  # grid_sample counts the last first
    field = field.to(route)[:, None]
    read = functional.grid_sample(field, grid[:, None], padding_mode="border", align_corners=True)[:, 0, 0]
    return torch.cat([4 * read, 10 * (CLEARANCE_M - read).clamp_min(0)], dim=-1)
