"""The localizers that are networks: scene-coordinate regression and the paper's pose regressor.

`SceneCoordinateNet` maps each patch by itself, so that its neighbours cannot spoil it, to the point of the
map under it (ACE, Brachmann et al. 2023). `PoseRegressor`, a ResNet-18 over dense descriptors with group
normalisation, regresses the camera's rotation (a unit quaternion) and position (Eq. 5). Both predict their
expected error, learned from the errors themselves.
"""

import itertools

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from pipeline.geometry import rigid, rigid_torch

MIN_LOG_M, MAX_LOG_M = -4.0, 3.0
"""Bounds of the predicted log distance (2 cm to 20 m)."""
GRID = 16
"""The descriptors are laid on a square grid of so many cells."""
GROUPS, HIDDEN = 8, 256
"""Groups of the normalisation, and units of the hidden layer of the head."""
MIN_LOG, MAX_LOG = -6.0, 3.0
"""Bounds of the predicted log error (radians + metres)."""
IDENTITY_BIAS = 1e-3
"""Added to the quaternion's real part, so that zero output is a rotation."""


class SceneCoordinateNet(nn.Module):
    """Patch descriptor -> point of the map in metres and the logarithm of the expected distance from it."""

    middle: Tensor
    extent: Tensor

    def __init__(self, axes: int, width: int, layers: int):
        super().__init__()
        self.arguments = {"axes": axes, "width": width, "layers": layers}
        sizes = [axes] + [width] * layers
        hidden = [part for i, o in itertools.pairwise(sizes) for part in (nn.Linear(i, o), nn.ReLU())]
        self.net = nn.Sequential(*hidden, nn.Linear(width, 4))
        self.register_buffer("middle", torch.zeros(3))
        self.register_buffer("extent", torch.ones(()))

    def forward(
        self, descriptors: Float[Tensor, "patch axis"]
    ) -> tuple[Float[Tensor, "patch 3"], Float[Tensor, "patch"]]:
        """Return points (metres) and log distances."""
        out = self.net(descriptors * descriptors.shape[-1] ** 0.5)
        return self.middle + self.extent * out[:, :3], out[:, 3].clamp(MIN_LOG_M, MAX_LOG_M)

    @torch.no_grad()
    def match(
        self, query: Float[np.ndarray, "query axis"]
    ) -> tuple[Float[np.ndarray, "query 3"], Float[np.ndarray, "query"]]:
        """Return the map's point under each patch (metres) and its precision as weight."""
        points, log_m = self(torch.from_numpy(np.ascontiguousarray(query, np.float32)))
        return points.double().numpy(), torch.exp(-2 * log_m).double().numpy()


def coordinate_loss(
    points: Float[Tensor, "patch 3"], log_m: Float[Tensor, "patch"], truth: Float[Tensor, "patch 3"]
) -> Float[Tensor, "patch"]:
    """Return |x - y| / b + log b, the negative log likelihood of a Laplace law of width b (metres)."""
    return (points - truth).norm(dim=-1) * torch.exp(-log_m) + log_m


class _Block(nn.Module):
    """Two 3x3 convolutions beside a shortcut (He et al. 2016), with normalisation by groups."""

    def __init__(self, before: int, after: int, stride: int):
        super().__init__()
        self.first, self.second = nn.Conv2d(before, after, 3, stride, 1), nn.Conv2d(after, after, 3, 1, 1)
        self.norms = nn.ModuleList([nn.GroupNorm(GROUPS, after), nn.GroupNorm(GROUPS, after)])
        self.shortcut = (
            nn.Identity() if before == after and stride == 1 else nn.Conv2d(before, after, 1, stride)
        )

    def forward(self, x: Tensor) -> Tensor:
        """Return the block's features."""
        inner = torch.relu(self.norms[0](self.first(x)))
        return torch.relu(self.norms[1](self.second(inner)) + self.shortcut(x))


class PoseRegressor(nn.Module):
    """Grid of descriptors -> quaternion, the anchor's position in the map (metres), log of expected error."""

    middle: Tensor
    extent: Tensor

    def __init__(self, axes: int, width: int):
        super().__init__()
        self.arguments = {"axes": axes, "width": width}
        widths = [width, width, 2 * width, 4 * width, 8 * width]
        blocks = []
        for index in range(4):
            blocks += [
                _Block(widths[index], widths[index + 1], 1 if index == 0 else 2),
                _Block(widths[index + 1], widths[index + 1], 1),
            ]
        self.trunk = nn.Sequential(nn.Conv2d(axes, width, 3, 1, 1), nn.ReLU(), *blocks)
        self.head = nn.Sequential(
            nn.Flatten(), nn.Linear(8 * width * (GRID // 8) ** 2, HIDDEN), nn.ReLU(), nn.Linear(HIDDEN, 8)
        )
        self.register_buffer("middle", torch.zeros(3))
        self.register_buffer("extent", torch.ones(()))

    def forward(
        self, grid: Float[Tensor, "batch axis row column"]
    ) -> tuple[Float[Tensor, "batch 3 3"], Float[Tensor, "batch 3"], Float[Tensor, "batch"]]:
        """Return rotations ``map_from_camera``, positions of the anchor in the map (metres), log errors."""
        out = self.head(self.trunk(grid * grid.shape[1] ** 0.5))
        quaternion = out[:, :4] + out.new_tensor([IDENTITY_BIAS, 0, 0, 0])
        return (
            rigid_torch.rotation_from_quaternion(quaternion),
            self.middle + self.extent * out[:, 4:7],
            out[:, 7].clamp(MIN_LOG, MAX_LOG),
        )

    @torch.no_grad()
    def regress(
        self,
        query: Float[np.ndarray, "patch axis"],
        cell: Int[np.ndarray, "patch 2"],
        anchor_camera: Float[np.ndarray, "3"],
    ) -> tuple[Float[np.ndarray, "4 4"], float]:
        """Return ``map_from_camera`` of one picture and a certainty in 0..1; the anchor is a point in camera
        axes, metres."""
        rotation, position, log_error = self(torch.from_numpy(on_grid(query, cell))[None])
        matrix = rotation[0].double().numpy()
        return rigid.make(matrix, position[0].double().numpy() - matrix @ anchor_camera), float(
            torch.exp(-torch.exp(log_error[0]))
        )


def on_grid(
    query: Float[np.ndarray, "patch axis"], cell: Int[np.ndarray, "patch 2"]
) -> Float[np.ndarray, "axis row column"]:
    """Arrange patches on the network's grid, centred, zero where there is none, subsampled to fit."""
    extent = cell.max(0) + 1
    place = (
        cell * GRID // max(int(extent.max()), GRID)
        + (GRID - np.minimum(extent * GRID // max(int(extent.max()), GRID), GRID)) // 2
    )
    grid = np.zeros((query.shape[1], GRID, GRID), np.float32)
    grid[:, place[:, 0], place[:, 1]] = query.T
    return grid


def pose_loss(
    rotation: Float[Tensor, "batch 3 3"], position: Float[Tensor, "batch 3"],
    log_error: Float[Tensor, "batch"],
    true_rotation: Float[Tensor, "batch 3 3"], true_position: Float[Tensor, "batch 3"],
) -> tuple[Float[Tensor, "batch"], Float[Tensor, "batch"]]:  # fmt: skip
    """Return angle + distance (radians + metres; Eq. 5), and the negative log likelihood of that error."""
    chord = (rotation - true_rotation).flatten(1).norm(dim=1) / 8**0.5
    error = 2 * torch.asin(chord.clamp(max=1 - 1e-6)) + (position - true_position).norm(dim=-1)
    return error, error.detach() * torch.exp(-log_error) + log_error
