"""Train the kinds of localizers that are networks, on the views that the bank would hold."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from pipeline.fit import fit
from pipeline.models.pose_regressor import PoseNet, on_grid, pose_loss
from pipeline.models.scene_coordinates import CoordinateNet, coordinate_loss
from pipeline.models.sight import Target
from stages.train_localizer.describing import Described


@dataclass(frozen=True)
class NetOptions:
    """Size and training of the networks."""

    steps: int = 2500
    """Steps of AdamW."""
    rate: float = 2e-3
    """Learning rate at the start; it falls to nothing along a cosine."""
    patches: int = 2048
    """Coordinates: patches a step."""
    views: int = 64
    """Regression: views a step."""
    coordinate_width: int = 384
    """Coordinates: hidden units ..."""
    coordinate_layers: int = 4
    """... and hidden layers."""
    pose_width: int = 32
    """Regression: channels of the first of four stages; the paper's ResNet-18 has 64."""


def train_coordinates(described: Described, options: NetOptions, seed: int) -> CoordinateNet:
    """Train a scene-coordinate network on all patches."""
    torch.manual_seed(seed)
    net = CoordinateNet(described.descriptors.shape[1], options.coordinate_width, options.coordinate_layers)
    descriptors, points = torch.from_numpy(described.descriptors), torch.from_numpy(described.points_map)
    _measure(net, points)

    def loss(_: int, generator: torch.Generator):
        chosen = torch.randint(len(descriptors), (options.patches,), generator=generator)
        return coordinate_loss(*net(descriptors[chosen]), points[chosen]).mean()

    return _train(net, loss, options, seed)


def train_regressor(described: Described, target: Target, options: NetOptions, seed: int) -> PoseNet:
    """Train the paper's regressor: scene views tell the camera's place, agent views the place of what they show."""
    torch.manual_seed(seed)
    net = PoseNet(described.descriptors.shape[1], options.pose_width)
    parts = np.split(described.descriptors, np.cumsum(described.counts)[:-1])
    grids = torch.from_numpy(np.stack([on_grid(part, patches.cell) for part, patches in zip(parts, described.patches, strict=True)]))
    rotation, place = (torch.from_numpy(value.astype(np.float32)) for value in _answers(described, target))
    _measure(net, place)

    def loss(_: int, generator: torch.Generator):
        chosen = torch.randint(len(grids), (options.views,), generator=generator)
        shown = grids[chosen] * (torch.rand(len(chosen), 1, *grids.shape[2:], generator=generator) > 0.15)
        error, surprise = pose_loss(*net(shown), rotation[chosen], place[chosen])
        return {"error": error.mean(), "surprise": 0.1 * surprise.mean()}

    return _train(net, loss, options, seed)


def _answers(described: Described, target: Target) -> tuple[Float[np.ndarray, "view 3 3"], Float[np.ndarray, "view 3"]]:
    poses = described.map_from_camera[described.view]
    if target == "scene":
        return poses[:, :3, :3], poses[:, :3, 3]
    middle = np.stack([np.median(patches.points_camera, axis=0) for patches in described.patches])
    return poses[:, :3, :3], np.einsum("vij,vj->vi", poses[:, :3, :3], middle) + poses[:, :3, 3]


def _measure(net, points):
    """Tell a network where the map lies and how large it is."""
    net.middle.copy_(points.mean(0))
    net.extent.copy_(points.std(0).norm())


def _train(net, loss, options, seed):
    optimizer = torch.optim.AdamW(net.parameters(), options.rate, weight_decay=1e-4)
    fit(
        modules={"net": net}, optimizer=optimizer, loss=loss, steps=options.steps, seed=seed, label="localizer", clip_norm=5.0,
        schedule=lambda done: min(1.0, 50 * done + 0.02) * (0.01 + 0.99 * (0.5 + 0.5 * np.cos(np.pi * done))),
    )  # fmt: skip
    return net.eval()
