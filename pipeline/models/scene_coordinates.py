"""Scene-coordinate regression: a network tells each patch the point of the map under it (ACE, Brachmann et al. 2023).

Each patch is asked by itself, so that its neighbours cannot spoil it; it also tells how far off it expects to be.
"""

import itertools

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

LEAST_LOG_M, MOST_LOG_M = -4.0, 3.0


class CoordinateNet(nn.Module):
    """Patch descriptor -> point of the map in metres and the logarithm of the expected distance from it."""

    def __init__(self, axes: int, width: int, layers: int):
        super().__init__()
        self._shape = {"axes": axes, "width": width, "layers": layers}
        sizes = [axes] + [width] * layers
        hidden = [part for i, o in itertools.pairwise(sizes) for part in (nn.Linear(i, o), nn.ReLU())]
        self.net = nn.Sequential(*hidden, nn.Linear(width, 4))
        self.register_buffer("middle", torch.zeros(3))
        self.register_buffer("extent", torch.ones(()))

    def shape(self) -> dict[str, int]:
        """Return the arguments that make a network like this one."""
        return dict(self._shape)

    def with_weights(self, arrays: dict[str, np.ndarray]) -> "CoordinateNet":
        """Load weights from a file."""
        self.load_state_dict({name: torch.from_numpy(value) for name, value in arrays.items()})
        return self

    def forward(self, descriptors: Float[Tensor, "patch axis"]) -> tuple[Float[Tensor, "patch 3"], Float[Tensor, "patch"]]:
        """Return points and log distances."""
        out = self.net(descriptors * descriptors.shape[-1] ** 0.5)
        return self.middle + self.extent * out[:, :3], out[:, 3].clamp(LEAST_LOG_M, MOST_LOG_M)

    @torch.no_grad()
    def correspond(self, query: Float[np.ndarray, "query axis"]) -> tuple[Float[np.ndarray, "query 3"], Float[np.ndarray, "query"]]:
        """Return the map's point under each patch and how far to trust it."""
        points, log_m = self(torch.from_numpy(np.ascontiguousarray(query, np.float32)))
        return points.double().numpy(), torch.exp(-2 * log_m).double().numpy()


def coordinate_loss(
    points: Float[Tensor, "patch 3"], log_m: Float[Tensor, "patch"], truth: Float[Tensor, "patch 3"]
) -> Float[Tensor, "patch"]:
    """Negative log likelihood of the distance under a Laplace-like law whose width is told per patch."""
    return (points - truth).norm(dim=-1) * torch.exp(-log_m) + log_m
