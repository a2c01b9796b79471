"""Inputs of the scene encoder in training, sampled from smoothed volumes."""

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.ndimage import convolve1d
from torch import Tensor

from pipeline.behavior.perception import FeatureVolume, grid_points_ego
from pipeline.behavior.scenes import Scenes
from pipeline.geometry import rigid_torch


class SceneSampler:
    """Samples the ego grid at the resolution of the scene encoder, fast enough for every step.

    The encoder averages blocks of cells. Here the volume is smoothed once by the same kernel, and sampled at
    the centers of the blocks.
    """

    def __init__(self, scenes: Scenes, stride: int, device: str):
        volumes, channels = scenes.volumes, scenes.channels
        flat = [_smoothed(volume, stride).reshape(volume.occupancy.size, channels) for volume in volumes]
        rows = np.concatenate([*flat, np.zeros((1, channels), np.float32)])
        self.features = torch.from_numpy(rows).to(device)
        self.points = torch.from_numpy(grid_points_ego(stride).astype(np.float32)).to(device)
        first = np.cumsum([0, *(len(part) for part in flat[:-1])])
        self.first = torch.from_numpy(first).to(device)
        origin = np.stack([volume.origin for volume in volumes]).astype(np.float32)
        self.origin = torch.from_numpy(origin).to(device)
        self.shape = torch.tensor([volume.occupancy.shape for volume in volumes], device=device)
        self.voxel_m = torch.tensor([volume.voxel_m for volume in volumes], device=device)

    def __call__(
        self,
        world_from_ego: Float[Tensor, "batch 4 4"],
        side: Float[Tensor, "batch"],
        scene: Int[Tensor, "batch"],
    ) -> Float[Tensor, "batch channel x y z"]:
        """Sample the grid in the volumes ``scene``; ``side`` is -1 for mirrored samples."""
        one = side.new_ones(len(side))
        points = self.points.flatten(0, 2) * torch.stack([side, one, one], dim=-1)[:, None]
        away = rigid_torch.apply(world_from_ego, points) - self.origin[scene][:, None]
        index, shape = (away / self.voxel_m[scene][:, None, None]).floor().long(), self.shape[scene][:, None]
        inside = ((index >= 0) & (index < shape)).all(-1)
        row = (index[..., 0] * shape[..., 1] + index[..., 1]) * shape[..., 2] + index[..., 2]
        row = row + self.first[scene][:, None]
        features = self.features[torch.where(inside, row, len(self.features) - 1)]
        return features.transpose(1, 2).unflatten(2, self.points.shape[:3])


def _smoothed(volume: FeatureVolume, stride: int) -> Float[np.ndarray, "x y z channel"]:
    """Smooth features like the average of the nearest voxels over blocks of ``stride`` cells."""
    features = volume.features.astype(np.float32)
    kernel = np.convolve(np.ones(stride), [0.5, 0.5]) / stride if stride > 1 else np.array([1.0])
    for axis in (1, 2, 3):
        features = convolve1d(features, kernel, axis=axis, mode="constant")
    return np.moveaxis(features, 0, -1)
