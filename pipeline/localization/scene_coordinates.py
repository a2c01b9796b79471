"""Scene-coordinate regression: a network maps each patch to the point of the map under it (ACE, Brachmann et
al. 2023).

Each patch is treated by itself, so that its neighbours cannot spoil it; its expected error is predicted too.
"""

import itertools

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

LEAST_LOG_M, MOST_LOG_M = -4.0, 3.0
"""Bounds of the predicted log distance (2 cm to 20 m)."""


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
        return self.middle + self.extent * out[:, :3], out[:, 3].clamp(LEAST_LOG_M, MOST_LOG_M)

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
    """Return the negative log likelihood |x - y| / b + log b of a Laplace law with predicted width b
    (metres)."""
    return (points - truth).norm(dim=-1) * torch.exp(-log_m) + log_m
