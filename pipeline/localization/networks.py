"""The paper's absolute pose regression.

`PoseRegressor`, a ResNet-18 with group normalization over dense descriptors, regresses the camera's rotation
(a unit quaternion) and position (Eq. 5), and its expected error.
"""

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from pipeline.geometry import rigid, rigid_torch

GRID = 16
"""Cells along each side of the regressor's descriptor grid."""
GROUPS, HIDDEN = 8, 256
"""Groups of the group normalization, and hidden units of the head."""
MIN_LOG, MAX_LOG = -6.0, 3.0
"""Bounds of the predicted log error (radians + meters)."""
IDENTITY_BIAS = 1e-3
"""Added to the quaternion's real part, so that zero output is a rotation."""


class _ResidualBlock(nn.Module):
    """Residual block of two 3x3 convolutions (He et al. 2016) with group normalization."""

    def __init__(self, c_in: int, c_out: int, stride: int):
        super().__init__()
        self.first, self.second = nn.Conv2d(c_in, c_out, 3, stride, 1), nn.Conv2d(c_out, c_out, 3, 1, 1)
        self.norms = nn.ModuleList([nn.GroupNorm(GROUPS, c_out), nn.GroupNorm(GROUPS, c_out)])
        self.shortcut = nn.Identity() if c_in == c_out and stride == 1 else nn.Conv2d(c_in, c_out, 1, stride)

    def forward(self, x: Tensor) -> Tensor:
        """Return the block's features."""
        hidden = torch.relu(self.norms[0](self.first(x)))
        return torch.relu(self.norms[1](self.second(hidden)) + self.shortcut(x))


class PoseRegressor(nn.Module):
    """Descriptor grid -> rotation, anchor position in the map (meters), log of the expected error."""

    middle: Tensor
    extent: Tensor

    def __init__(self, axes: int, width: int):
        super().__init__()
        self.arguments = {"axes": axes, "width": width}
        widths = [width, width, 2 * width, 4 * width, 8 * width]
        blocks = []
        for index in range(4):
            blocks += [
                _ResidualBlock(widths[index], widths[index + 1], 1 if index == 0 else 2),
                _ResidualBlock(widths[index + 1], widths[index + 1], 1),
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
        """Return rotations ``map_from_camera``, positions of the anchor in the map (meters), log errors."""
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
        """Return ``map_from_camera`` of one picture and a certainty in 0..1.

        ``anchor_camera`` is the point whose map position is regressed, camera frame, meters.
        """
        grid = torch.from_numpy(on_grid(query, cell))[None].to(self.extent.device)
        rotation, position, log_error = (value[0].cpu() for value in self(grid))
        matrix = rotation.double().numpy()
        certainty = float(torch.exp(-torch.exp(log_error)))
        return rigid.make(matrix, position.double().numpy() - matrix @ anchor_camera), certainty


def on_grid(
    query: Float[np.ndarray, "patch axis"], cell: Int[np.ndarray, "patch 2"]
) -> Float[np.ndarray, "axis row column"]:
    """Scatter patches onto the regressor's grid: centered, subsampled to fit, zero where empty."""
    extent = cell.max(0) + 1
    target = (
        cell * GRID // max(int(extent.max()), GRID)
        + (GRID - np.minimum(extent * GRID // max(int(extent.max()), GRID), GRID)) // 2
    )
    grid = np.zeros((query.shape[1], GRID, GRID), np.float32)
    grid[:, target[:, 0], target[:, 1]] = query.T
    return grid


def pose_loss(
    rotation: Float[Tensor, "batch 3 3"], position: Float[Tensor, "batch 3"],
    log_error: Float[Tensor, "batch"],
    true_rotation: Float[Tensor, "batch 3 3"], true_position: Float[Tensor, "batch 3"],
) -> tuple[Float[Tensor, "batch"], Float[Tensor, "batch"]]:  # fmt: skip
    """Return the loss of Eq. 5, geodesic angle plus squared distance (radians, square meters), and the
    negative log likelihood of angle plus distance.
    """
    chord = (rotation - true_rotation).flatten(1).norm(dim=1) / 8**0.5
    angle, distance = 2 * torch.asin(chord.clamp(max=1 - 1e-6)), (position - true_position).norm(dim=-1)
    error = (angle + distance).detach()
    return angle + distance.square(), error * torch.exp(-log_error) + log_error
