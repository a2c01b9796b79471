"""Denoising of the body along a path: conditioned on where the path leads, it predicts how the body departs
from its posture.

`BodyDenoiser` wraps the UNet of the body. The posture that the animal holds now, turned as the path turns, is
taken from the noisy body before the UNet sees it; what is left is small for an animal that stays, and no
heading for one that walks.
"""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from pipeline.behavior.diffusion import STANDARD, Schedule
from pipeline.behavior.path_encoding import PATH_CHANNELS, expected_steps
from pipeline.behavior.trajectories import RATE_HZ

CONTROL_CHANNELS = 8
"""channels of a path that condition the UNet: position, velocity, heading"""
ROOT_CHANNELS = 6
"""the body's leading channels: the root's rotation in the ego frame, its x and its y axis"""
HEADING_MEMORY_M = 0.1
"""way after which an earlier heading counts for a third"""
PATH_NOISE_M = 0.02
"""step of a path, per frame, of which half is taken for noise"""

MIN_DIRECTION = 0.01
"""length of a vector, in metres or of a unit, below which it has no direction"""


class BodyDenoiser(nn.Module):
    """Denoise what a body does along a path: its departure from the posture that it holds now.

    The last numbers of the condition are the posture, scaled as the body is but for its root rotation, or
    zeros where nothing is remembered. With x_t = sqrt(alpha_bar) clean + sqrt(1 - alpha_bar) noise the same
    noise is in x_t - sqrt(alpha_bar) posture.
    """

    path_std: Tensor
    root_mean: Tensor
    root_std: Tensor
    rotation_std: Tensor
    share: Tensor
    past: Tensor

    def __init__(
        self,
        unet: nn.Module,
        posture: int,
        frames: int,
        schedule: Schedule = STANDARD,
        rate_hz: float = RATE_HZ,
    ):
        super().__init__()
        self.unet, self.posture, self.rate_hz = unet, posture, rate_hz
        self.register_buffer("path_std", torch.ones(3, frames))
        self.register_buffer("root_mean", torch.zeros(ROOT_CHANNELS))
        self.register_buffer("root_std", torch.ones(ROOT_CHANNELS))
        self.register_buffer("rotation_std", torch.ones(ROOT_CHANNELS))
        self.register_buffer("share", torch.from_numpy(schedule.alpha_bar).float().sqrt(), persistent=False)
        self.register_buffer("past", torch.ones(frames, frames).tril(), persistent=False)

    def forward(
        self,
        x: Float[Tensor, "batch channel frame"],
        t: Float[Tensor, "batch"],
        condition: Float[Tensor, "batch condition"],
        control: Float[Tensor, "batch 3 frame"],
        keep: Float[Tensor, "batch 1"] | None,
    ) -> Float[Tensor, "batch channel frame"]:
        held = condition[:, -self.posture :, None].expand(-1, -1, x.shape[-1])
        root = held[:, :ROOT_CHANNELS] * self.root_std[:, None] + self.root_mean[:, None]
        step = self.steps(x, t, control)
        heading = self.headings(step, root)
        root = (rotated_to_heading(root, heading) - self.root_mean[:, None]) / self.rotation_std[:, None]
        held = torch.cat([root, held[:, ROOT_CHANNELS:]], dim=1)
        held = nn.functional.pad(held, (0, 0, x.shape[1] - self.posture, 0))
        unet_control = torch.cat([control, step * self.rate_hz, heading], dim=1)
        return self.unet(x - self.share[t.long()][:, None, None] * held, t, condition, unet_control, keep)

    def steps(
        self,
        x: Float[Tensor, "batch channel frame"],
        t: Float[Tensor, "batch"],
        control: Float[Tensor, "batch 3 frame"],
    ) -> Float[Tensor, "batch 3 frame"]:
        """Return how far the path goes in each frame, metres; in the first as in the second."""
        del x, t
        place = control * self.path_std
        step = place[..., 1:] - place[..., :-1]
        return torch.cat([step[..., :1], step], dim=-1)

    def headings(
        self, step: Float[Tensor, "batch 3 frame"], root: Float[Tensor, "batch 6 frame"]
    ) -> Float[Tensor, "batch 2 frame"]:
        """Return where a body looks that looks where it goes, and stays as it is while it stays: horizontal
        unit vectors.

        Each is the sum of all steps before, which are forgotten with the way that was made since, and of the
        heading at the beginning.
        """
        level = step[:, ::2]
        square = level.square().sum(1, keepdim=True)
        level = level * (square / (square + PATH_NOISE_M**2))
        way = (level.square().sum(1) + 1e-12).sqrt().cumsum(-1)
        since = (way[:, None, :] - way[:, :, None]).clamp(max=0)
        gone = level @ (torch.exp(since / HEADING_MEMORY_M) * self.past).transpose(-1, -2)
        return soft_unit(
            gone + HEADING_MEMORY_M * torch.exp(-way / HEADING_MEMORY_M)[:, None] * horizontal_forward(root)
        )


class OneStageDenoiser(BodyDenoiser):
    """Denoise path and body as one sequence, path first; the heading is that of the noisy path."""

    velocity_std: Tensor

    def __init__(
        self,
        unet: nn.Module,
        posture: int,
        frames: int,
        schedule: Schedule = STANDARD,
        rate_hz: float = RATE_HZ,
    ):
        super().__init__(unet, posture, frames, schedule, rate_hz)
        self.register_buffer("velocity_std", torch.ones(PATH_CHANNELS))

    def steps(
        self,
        x: Float[Tensor, "batch channel frame"],
        t: Float[Tensor, "batch"],
        control: Float[Tensor, "batch 3 frame"],
    ) -> Float[Tensor, "batch 3 frame"]:
        """Return how far the noisy path is expected to go in each frame, metres."""
        del control
        strides = (self.share[t.long()][:, None, None] * x[:, :PATH_CHANNELS]).transpose(-1, -2)
        return expected_steps(strides * self.velocity_std, self.rate_hz).transpose(-1, -2)


def horizontal_forward(root: Float[Tensor, "batch 6 frame"]) -> Float[Tensor, "batch 2 frame"]:
    """Return the horizontal part of the z axis of rotations given by their x and y axes."""
    (_, x1, x2), (y0, y1, y2) = root[:, :3].unbind(1), root[:, 3:].unbind(1)
    x0 = root[:, 0]
    return torch.stack([x1 * y2 - x2 * y1, x0 * y1 - x1 * y0], dim=1)


def rotated_to_heading(
    root: Float[Tensor, "batch 6 frame"], heading: Float[Tensor, "batch 2 frame"]
) -> Float[Tensor, "batch 6 frame"]:
    """Turn rotations (x and y axis, ego frame) about the vertical so that they look along ``heading``."""
    now = soft_unit(horizontal_forward(root))
    cosine = (now * heading).sum(1, keepdim=True)
    sine = (heading[:, 0] * now[:, 1] - heading[:, 1] * now[:, 0])[:, None]
    x, y, z = root.unflatten(1, (2, 3)).unbind(2)
    return torch.stack([cosine * x + sine * z, y, cosine * z - sine * x], dim=2).flatten(1, 2)


def soft_unit(vector: Float[Tensor, "batch 2 frame"]) -> Float[Tensor, "batch 2 frame"]:
    """Return vectors of about length 1, shorter where there is hardly a direction."""
    return vector / (vector.square().sum(1, keepdim=True) + MIN_DIRECTION**2).sqrt()
