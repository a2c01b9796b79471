"""Encoders of past motion: that of others, people and animals (Eq. 12), and the agent's own (Eq. 13)."""

from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor, nn

from pipeline.behavior.trajectories import ABSENT_M, ANTICIPATED_SHARES
from pipeline.geometry import rigid_torch

POSE_CHANNELS = 9
"""channels of a pose in the ego frame: position and 6D rotation; the kind follows"""
MAX_PRESENT_M = 100.0
"""others beyond this distance are absent: recordings place absent ones 1 km away"""
CLOSE_RANGE_M, EDGE_SHARPNESS = 1.5, 4.0
"""offset of the encoded distance, meters, and steepness of the soft edge at the radius, per radius"""
APPROACH_SCALE = 1.5
"""scale of approach speeds (at most 2 m/s), which gives them the range of the encoded distance, +-3"""
MAX_MOTION_M = 3.0
"""bound of the encoded motion of others until an anticipated frame"""
HEADS = 4
"""attention heads, each for its part of the code"""
ATTENDED_CHANNELS = 3
"""presence of the others that a head attends to, 0..1, and their mean horizontal position times presence"""
MIN_WEIGHT = 1e-6
"""attention weight of others beyond the radius, so that weights can be normalized when nobody is near"""


def mlp(sizes: tuple[int, ...], dropout: float = 0.0) -> nn.Sequential:
    """Return linear layers of these sizes with SiLU (and dropout) between them."""
    layers: list[nn.Module] = []
    for inner, outer in pairwise(sizes):
        layers += [nn.Linear(inner, outer), nn.SiLU(), nn.Dropout(dropout)]
    return nn.Sequential(*layers[:-2])


def other_channels_torch(
    position: Float[Tensor, "batch past_frame 3"],
    rotation: Float[Tensor, "batch past_frame 3 3"],
    companions: Float[Tensor, "batch companion past_frame 4"],
    new_from_ego: Float[Tensor, "batch 3 3"],
) -> Float[Tensor, "batch other past_frame 10"]:
    """Return the encoder input of observer and companions, as `model.other_channels` does."""
    first = nn.functional.pad(torch.cat([position, rigid_torch.rotation_to_6d(rotation)], dim=-1), (0, 1))
    place = companions[..., :3] @ new_from_ego.mT[:, None]
    unknown = place.new_zeros(*place.shape[:3], POSE_CHANNELS - 3)
    return torch.cat([first[:, None], torch.cat([place, unknown, companions[..., 3:]], dim=-1)], dim=1)


def with_anticipated(
    others: Float[Tensor, "batch other past_frame 10"], ahead: Float[Tensor, "batch anticipated_frame 3"]
) -> Float[Tensor, "batch other frame 10"]:
    """Append frames with where the observer will be, meters; that of companions is unknown."""
    more = others.new_zeros(*others.shape[:2], ahead.shape[1], others.shape[3])
    more[..., 0] = ABSENT_M
    more[:, 0, :, :3] = ahead
    return torch.cat([others, more], dim=2)


class SetEncoder(nn.Module):
    """Permutation-invariant encoder of a set: shared layers and attention pooling (Ilse et al. 2018) weighted
    by nearness, so that others fade out as they leave. The code of zero features is the learned null.
    """

    def __init__(self, numbers: int, hidden: int, code: int):
        super().__init__()
        self.layers = mlp((numbers, hidden, hidden, code))
        self.animal = nn.Parameter(torch.zeros(hidden))
        self.attention = nn.Parameter(torch.zeros(HEADS, code))

    def code_of_set(
        self,
        features: Float[Tensor, "batch other number"],
        kind: Float[Tensor, "batch other 1"],
        inside: Float[Tensor, "batch other 1"],
        keep: Float[Tensor, "batch"],
    ) -> tuple[Float[Tensor, "batch code"], Float[Tensor, "batch other head"]]:
        """Return code and attention; features are zero where ``inside`` is 0; a set of one is not pooled."""
        present = keep[:, None, None]
        hidden = self.layers[0](features * present) + kind * inside * present * self.animal
        codes = self.layers[1:](hidden)
        if codes.shape[1] == 1:
            return codes[:, 0], torch.ones_like(inside).expand(-1, -1, HEADS)
        weight = (codes @ self.attention.transpose(-1, -2) + (inside + MIN_WEIGHT).log()).softmax(1)
        return (codes.unflatten(-1, (HEADS, -1)) * weight[..., None]).sum(1).flatten(1), weight


class OthersEncoder(SetEncoder):
    """Encode the past positions of others by features that vanish towards ``radius_m``.

    Distance and approach speed of each frame (meters, m/s) are explicit features, undamped well inside the
    radius: they decide whether the animal reacts, and learning them from positions takes thousands of steps.
    Beyond the radius all features are zero, so that far others and none at all have the same code.

    Behind the past frames there may be those of `anticipated_frames`, with where the others will be. Without
    them, and where others are absent in them, it is unknown.
    """

    anticipates = True

    def __init__(
        self, frames: int, hidden: int, code: int, radius_m: float, rate_hz: float, *, positions: bool = False
    ):
        super().__init__(frames * 5 + 2 + len(ANTICIPATED_SHARES) * 5, hidden, code)
        self.frames, self.radius_m, self.rate_hz, self.positions = frames, radius_m, rate_hz, positions

    def forward(
        self, others: Float[Tensor, "batch other frame 10"], keep: Float[Tensor, "batch"]
    ) -> Float[Tensor, "batch number"]:
        """Return the code, then with ``positions`` `ATTENDED_CHANNELS` per head."""
        position = others[..., : self.frames, :3:2]
        distance = (position.square().sum(-1) + 1e-6).sqrt()
        nearness = (1 - distance / self.radius_m).clamp_min(0)
        direction = position / (distance[..., None] + 0.1)
        velocity = (position[..., -1, :] - position[..., 0, :]) * (self.rate_hz / (self.frames - 1))
        closing = -(velocity * direction[..., -1, :]).sum(-1, keepdim=True)
        seen = torch.cat([direction * nearness[..., None], nearness[..., None]], dim=-1).flatten(-2)
        moving = torch.cat([velocity, closing], dim=-1) * nearness[..., -1:]
        inside = (nearness * EDGE_SHARPNESS).clamp_max(1)
        close = (CLOSE_RANGE_M - distance).clamp_min(-CLOSE_RANGE_M) * (2 * inside)
        step = (position[..., 1:, :] - position[..., :-1, :]) * self.rate_hz
        coming = -(step * direction[..., 1:, :]).sum(-1).clamp(-2, 2) * (APPROACH_SCALE * inside[..., 1:])
        inside = inside[..., -1:]
        ahead = self._ahead(others[..., self.frames :, :3:2], position[..., -1:, :], inside)
        features = torch.cat([seen, moving.clamp(-2, 2), close, coming, ahead], dim=-1)
        code, weight = self.code_of_set(features, others[..., self.frames - 1, -1:], inside, keep)
        if not self.positions:
            return code
        here = torch.cat([inside, inside * position[..., -1, :]], dim=-1)
        attended = (weight[..., None] * here[:, :, None]).sum(1).flatten(1)
        return torch.cat([code, attended * keep[:, None]], dim=-1)

    def _ahead(
        self,
        then: Float[Tensor, "batch other anticipated_frame 2"],
        now: Float[Tensor, "batch other 1 2"],
        inside: Float[Tensor, "batch other 1"],
    ) -> Float[Tensor, "batch other number"]:
        """Return features of where others will be: motion, nearness, approach, and whether it is known."""
        if not then.shape[2]:
            then = torch.full_like(now, ABSENT_M).expand(-1, -1, len(ANTICIPATED_SHARES), -1)
        known = (then.abs().amax(-1) < MAX_PRESENT_M).to(inside) * inside
        distance, from_now = ((place.square().sum(-1) + 1e-6).sqrt() for place in (then, now))
        close = (CLOSE_RANGE_M - distance).clamp(-CLOSE_RANGE_M, CLOSE_RANGE_M) * 2
        coming = (from_now - distance).clamp(-2, 2) * APPROACH_SCALE
        each = torch.stack([close, coming, torch.full_like(close, 2)], dim=-1)
        each = torch.cat([(then - now).clamp(-MAX_MOTION_M, MAX_MOTION_M), each], dim=-1)
        return (each * known[..., None]).flatten(-2)


class OtherPosesEncoder(SetEncoder):
    """Encode the past poses of others, without a radius (Eq. 12); not where they will be."""

    anticipates = False

    def __init__(self, frames: int, hidden: int, code: int):
        super().__init__(frames * POSE_CHANNELS, hidden, code)
        self.frames = frames

    def forward(
        self, others: Float[Tensor, "batch other past_frame 10"], keep: Float[Tensor, "batch"]
    ) -> Float[Tensor, "batch code"]:
        others = others[:, :, : self.frames]
        near = (others[..., :3].square().sum(-1) < MAX_PRESENT_M**2).all(-1, keepdim=True)
        features = torch.where(near, others[..., :POSE_CHANNELS].flatten(-2), 0)
        return self.code_of_set(features, others[..., -1, -1:], near.to(features), keep)[0]


class PastEncoder(nn.Module):
    """Encode the agent's past: root poses in the ego frame, their changes, and bones (Eq. 13)."""

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
        """``bones_keep`` is for training: 0 replaces the bones of a sample by their mean."""
        past = (past.unflatten(1, (self.frames, -1)) - self.mean) / self.std
        bones = past[:, :, 9:].flatten(1)
        if bones_keep is not None:
            bones = bones * bones_keep[:, None]
        root = past[:, :, :9]
        change = ((root[:, 1:] - root[:, :-1]) * self.CHANGE).clamp(-self.CHANGE, self.CHANGE)
        return self.layers(torch.cat([root.flatten(1), change.flatten(1), self.bones(bones)], dim=-1))
