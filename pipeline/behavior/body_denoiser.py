"""The denoiser of body motion along a path, relative to the current posture.

`BodyDenoiser` wraps the UNet of the body. The current posture, rotated to the heading of the path, is
subtracted from the noisy body before the UNet reads it. The residual is small for a resting animal, and free
of heading for a walking one.
"""

import torch
from jaxtyping import Float
from torch import Tensor, nn

from pipeline.behavior.diffusion import STANDARD, Schedule
from pipeline.behavior.path_encoding import PATH_CHANNELS, expected_steps
from pipeline.behavior.trajectories import RATE_HZ

CONTROL_CHANNELS = 8
"""channels of a path as it controls the UNet: position, velocity, heading"""
ROOT_CHANNELS = 6
"""the body's leading channels: x and y axis of the root's rotation, ego frame"""
HEADING_MEMORY_M = 0.1
"""distance over which the weight of earlier headings decays by a factor of e"""
PATH_NOISE_M = 0.02
"""step per frame at which the direction of a path has weight one half; shorter steps are mostly noise"""

MIN_DIRECTION = 0.01
"""length (metres, or of a unit vector) below which a vector has no direction"""


class BodyDenoiser(nn.Module):
    """Denoise a body along a path as the residual from its current posture.

    The last channels of the condition are the posture, scaled as the body is except for the root rotation;
    zeros if the past is dropped. With x_t = sqrt(alpha_bar) clean + sqrt(1 - alpha_bar) noise, subtracting
    sqrt(alpha_bar) posture leaves the noise unchanged.
    """

    path_std: Tensor
    root_mean: Tensor
    root_std: Tensor
    rotation_std: Tensor
    sqrt_alpha_bar: Tensor
    causal_mask: Tensor

    def __init__(
        self,
        unet: nn.Module,
        posture_channels: int,
        frames: int,
        schedule: Schedule = STANDARD,
        rate_hz: float = RATE_HZ,
    ):
        super().__init__()
        self.unet, self.posture_channels, self.rate_hz = unet, posture_channels, rate_hz
        self.register_buffer("path_std", torch.ones(3, frames))
        self.register_buffer("root_mean", torch.zeros(ROOT_CHANNELS))
        self.register_buffer("root_std", torch.ones(ROOT_CHANNELS))
        self.register_buffer("rotation_std", torch.ones(ROOT_CHANNELS))
        sqrt_alpha_bar = torch.from_numpy(schedule.alpha_bar).float().sqrt()
        self.register_buffer("sqrt_alpha_bar", sqrt_alpha_bar, persistent=False)
        self.register_buffer("causal_mask", torch.ones(frames, frames).tril(), persistent=False)

    def forward(
        self,
        x: Float[Tensor, "batch channel frame"],
        t: Float[Tensor, "batch"],
        condition: Float[Tensor, "batch condition"],
        control: Float[Tensor, "batch 3 frame"],
        keep: Float[Tensor, "batch 1"] | None,
    ) -> Float[Tensor, "batch channel frame"]:
        posture = condition[:, -self.posture_channels :, None].expand(-1, -1, x.shape[-1])
        root = posture[:, :ROOT_CHANNELS] * self.root_std[:, None] + self.root_mean[:, None]
        step = self.steps(x, t, control)
        heading = self.headings(step, root)
        root = (rotated_to_heading(root, heading) - self.root_mean[:, None]) / self.rotation_std[:, None]
        posture = torch.cat([root, posture[:, ROOT_CHANNELS:]], dim=1)
        posture = nn.functional.pad(posture, (0, 0, x.shape[1] - self.posture_channels, 0))
        unet_control = torch.cat([control, step * self.rate_hz, heading], dim=1)
        residual = x - self.sqrt_alpha_bar[t.long()][:, None, None] * posture
        return self.unet(residual, t, condition, unet_control, keep)

    def steps(
        self,
        x: Float[Tensor, "batch channel frame"],
        t: Float[Tensor, "batch"],
        control: Float[Tensor, "batch 3 frame"],
    ) -> Float[Tensor, "batch 3 frame"]:
        """Return the displacement per frame, metres; the first frame repeats the second."""
        del x, t
        place = control * self.path_std
        step = place[..., 1:] - place[..., :-1]
        return torch.cat([step[..., :1], step], dim=-1)

    def headings(
        self, step: Float[Tensor, "batch 3 frame"], root: Float[Tensor, "batch 6 frame"]
    ) -> Float[Tensor, "batch 2 frame"]:
        """Return the heading of a body that faces where it goes and keeps its heading at rest: horizontal
        unit vectors.

        Each is an average of the initial heading and all earlier steps, with weights that decay
        exponentially with the distance travelled since.
        """
        horizontal = step[:, ::2]
        square = horizontal.square().sum(1, keepdim=True)
        horizontal = horizontal * (square / (square + PATH_NOISE_M**2))
        travelled = (horizontal.square().sum(1) + 1e-12).sqrt().cumsum(-1)
        since = (travelled[:, None, :] - travelled[:, :, None]).clamp(max=0)
        displacement = horizontal @ (torch.exp(since / HEADING_MEMORY_M) * self.causal_mask).transpose(-1, -2)
        return soft_unit(
            displacement
            + HEADING_MEMORY_M * torch.exp(-travelled / HEADING_MEMORY_M)[:, None] * horizontal_forward(root)
        )


class OneStageDenoiser(BodyDenoiser):
    """Denoise path and body as one sequence, path channels first; the heading is that of the noisy path."""

    velocity_std: Tensor

    def __init__(
        self,
        unet: nn.Module,
        posture_channels: int,
        frames: int,
        schedule: Schedule = STANDARD,
        rate_hz: float = RATE_HZ,
    ):
        super().__init__(unet, posture_channels, frames, schedule, rate_hz)
        self.register_buffer("velocity_std", torch.ones(PATH_CHANNELS))

    def steps(
        self,
        x: Float[Tensor, "batch channel frame"],
        t: Float[Tensor, "batch"],
        control: Float[Tensor, "batch 3 frame"],
    ) -> Float[Tensor, "batch 3 frame"]:
        """Return the expected displacement per frame given the noisy path, metres."""
        del control
        strides = (self.sqrt_alpha_bar[t.long()][:, None, None] * x[:, :PATH_CHANNELS]).transpose(-1, -2)
        return expected_steps(strides * self.velocity_std, self.rate_hz).transpose(-1, -2)


def horizontal_forward(root: Float[Tensor, "batch 6 frame"]) -> Float[Tensor, "batch 2 frame"]:
    """Return the horizontal part of the z axis of rotations given by their x and y axes."""
    (_, x1, x2), (y0, y1, y2) = root[:, :3].unbind(1), root[:, 3:].unbind(1)
    x0 = root[:, 0]
    return torch.stack([x1 * y2 - x2 * y1, x0 * y1 - x1 * y0], dim=1)


def rotated_to_heading(
    root: Float[Tensor, "batch 6 frame"], heading: Float[Tensor, "batch 2 frame"]
) -> Float[Tensor, "batch 6 frame"]:
    """Rotate orientations (x and y axis, ego frame) about the vertical to face along ``heading``."""
    now = soft_unit(horizontal_forward(root))
    cosine = (now * heading).sum(1, keepdim=True)
    sine = (heading[:, 0] * now[:, 1] - heading[:, 1] * now[:, 0])[:, None]
    x, y, z = root.unflatten(1, (2, 3)).unbind(2)
    return torch.stack([cosine * x + sine * z, y, cosine * z - sine * x], dim=2).flatten(1, 2)


def soft_unit(vector: Float[Tensor, "batch 2 frame"]) -> Float[Tensor, "batch 2 frame"]:
    """Return vectors normalised to about length 1; shorter where the direction is ill-defined."""
    return vector / (vector.square().sum(1, keepdim=True) + MIN_DIRECTION**2).sqrt()
