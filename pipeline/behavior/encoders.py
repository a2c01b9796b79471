"""Encoders of the last 0.8 s of motion: the observer's (Eq. 12), and the agent's own (Eq. 13)."""

from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor, nn

POSE_CHANNELS = 9
"""numbers of an observer's pose in the ego frame: position, and the first two columns of its rotation"""
NOBODY_M = 100.0
"""an observer further away is none: recordings without one put it 1 km off"""
CLOSE_RANGE_M, EDGE_SHARPNESS = 1.5, 4.0
"""distance around which an observer's is encoded, metres, and the inverse width, in radii, of the soft edge
at the radius"""


def mlp(sizes: tuple[int, ...], dropout: float = 0.0) -> nn.Sequential:
    """Return linear layers of these sizes with SiLU (and dropout) between them."""
    layers: list[nn.Module] = []
    for inner, outer in pairwise(sizes):
        layers += [nn.Linear(inner, outer), nn.SiLU(), nn.Dropout(dropout)]
    return nn.Sequential(*layers[:-2])


class ObserverEncoder(nn.Module):
    """Encode the observer's past positions (Eq. 12) through features that vanish towards ``radius_m``.

    Distance and approach speed are encoded frame by frame in metres and m/s, well inside the radius undamped:
    whether the animal minds hangs on them, and to learn them from positions takes thousands of steps. Beyond
    the radius all features are zero, so that a far observer and none at all are the same to the agent: the
    code of zero features is also the learned null.
    """

    def __init__(self, frames: int, hidden: int, code: int, radius_m: float, rate_hz: float):
        super().__init__()
        self.frames, self.radius_m, self.rate_hz = frames, radius_m, rate_hz
        self.layers = mlp((frames * 5 + 2, hidden, hidden, code))

    def forward(
        self, observer_past: Float[Tensor, "batch observer_past"], keep: Float[Tensor, "batch"]
    ) -> Float[Tensor, "batch code"]:
        position = observer_past.unflatten(1, (self.frames, POSE_CHANNELS))[:, :, 0:3:2]
        distance = (position.square().sum(-1) + 1e-6).sqrt()
        nearness = (1 - distance / self.radius_m).clamp_min(0)
        direction = position / (distance[..., None] + 0.1)
        velocity = (position[:, -1] - position[:, 0]) * (self.rate_hz / (self.frames - 1))
        closing = -(velocity * direction[:, -1]).sum(-1, keepdim=True)
        seen = torch.cat([direction * nearness[..., None], nearness[..., None]], dim=-1).flatten(1)
        moving = torch.cat([velocity, closing], dim=-1) * nearness[:, -1:]
        inside = (nearness * EDGE_SHARPNESS).clamp_max(1)
        close = (CLOSE_RANGE_M - distance).clamp_min(-CLOSE_RANGE_M) * (2 * inside)
        coming = -(position.diff(dim=1) * self.rate_hz * direction[:, 1:]).sum(-1).clamp(-2, 2) * (
            1.5 * inside[:, 1:]
        )
        return self.layers(torch.cat([seen, moving.clamp(-2, 2), close, coming], dim=-1) * keep[:, None])


class ObserverPoseEncoder(nn.Module):
    """Encode the observer's past poses, without a radius (Eq. 12); the null is the code of zeros."""

    def __init__(self, frames: int, hidden: int, code: int):
        super().__init__()
        self.frames = frames
        self.layers = mlp((frames * POSE_CHANNELS, hidden, hidden, code))

    def forward(
        self, observer_past: Float[Tensor, "batch observer_past"], keep: Float[Tensor, "batch"]
    ) -> Float[Tensor, "batch code"]:
        position = observer_past.unflatten(1, (self.frames, POSE_CHANNELS))[:, :, :3]
        near = (position.square().sum(-1) < NOBODY_M**2).all(1)
        return self.layers(torch.where(near[:, None], observer_past, 0) * keep[:, None])


class PastEncoder(nn.Module):
    """Encode the agent's own past: root poses in the ego frame, their changes, and bones (Eq. 13), normalised
    inside.
    """

    CHANGE = 3.0
    """scale of changes from frame to frame, and their bound"""
    mean: Tensor
    std: Tensor

    def __init__(self, frames: int, channels: int, hidden: int, code: int):
        super().__init__()
        self.frames = frames
        self.register_buffer("mean", torch.zeros(channels))
        self.register_buffer("std", torch.ones(channels))
        self.bones = nn.Linear(frames * (channels - 9), 32)
        self.layers = mlp(((2 * frames - 1) * 9 + 32, hidden, hidden, code))

    def forward(
        self, past: Float[Tensor, "batch past"], bones_keep: Float[Tensor, "batch"] | None = None
    ) -> Float[Tensor, "batch code"]:
        """``bones_keep`` is for training: 0 hides the bones of a sample (they take their mean)."""
        past = (past.unflatten(1, (self.frames, -1)) - self.mean) / self.std
        bones = past[:, :, 9:].flatten(1)
        if bones_keep is not None:
            bones = bones * bones_keep[:, None]
        root = past[:, :, :9]
        change = (root.diff(dim=1) * self.CHANGE).clamp(-self.CHANGE, self.CHANGE)
        return self.layers(torch.cat([root.flatten(1), change.flatten(1), self.bones(bones)], dim=-1))
