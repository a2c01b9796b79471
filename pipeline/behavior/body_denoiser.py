"""The denoiser of body motion along a path, relative to the current posture.

`BodyDenoiser` wraps the UNet of the body. What a Gaussian prior expects given the current posture, rotated to
the heading of the path, is subtracted from the noisy body before the UNet reads it. The residual is small for
a resting animal, and free of heading for a walking one.
"""

from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from scipy.fft import dct
from torch import Tensor, nn

from pipeline.behavior.denoisers import Conditions, Keep, SequenceDenoiser, Sequences, Steps
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
Paths = Float[Tensor, "batch 3 frame"]
"""Scaled positions in the ego frame"""
MIN_DIRECTION = 0.01
"""length (meters, or of a unit vector) below which a vector has no direction"""


class GaussianPrior(nn.Module):
    """A Gaussian prior of body motion, which preconditions its denoiser.

    White noise in all channels of all bones does not fit through the narrow layers of a small UNet. Most of
    it is removed linearly instead: given the posture, motion has little variance in most principal components
    of the bones, and little at high frequencies of a cosine transform. With one variance per component and
    frequency, this is the preconditioning of Karras et al. 2022 (Table 1); for variance 1 it is v-prediction.
    The UNet reads and corrects the leading components, whitened; the loss remains that of the noise in all
    channels. The leading channels, before those of bones, are components themselves and keep variance 1, as
    all do before `fit`.
    """

    basis: Tensor
    weight: Tensor
    std: Tensor
    cosines: Tensor
    signal: Tensor
    sigma: Tensor

    def __init__(self, leading: int, bones: int, components: int, frames: int, schedule: Schedule = STANDARD):
        """``leading`` and ``bones``: channels; ``components``: those of bones that the UNet corrects."""
        super().__init__()
        self.leading, self.corrected = leading, leading + components
        self.register_buffer("basis", torch.eye(leading + bones))
        self.register_buffer("weight", torch.ones(leading + bones, frames))
        self.register_buffer("std", torch.ones(leading + bones, frames))
        cosines = torch.from_numpy(dct(np.eye(frames), norm="ortho", axis=1)).float()
        alpha_bar = torch.from_numpy(schedule.alpha_bar).float()
        self.register_buffer("cosines", cosines, persistent=False)
        self.register_buffer("signal", alpha_bar.sqrt(), persistent=False)
        self.register_buffer("sigma", (1 - alpha_bar).sqrt(), persistent=False)

    @torch.no_grad()
    def fit(
        self, posture: Float[Tensor, "sequence channel frame"], clean: Float[Tensor, "sequence channel frame"]
    ) -> None:
        """Fit the bones to sequences and the postures that they begin with."""
        bones = clean[:, self.leading :].transpose(0, 1).flatten(1)
        _, vectors = torch.linalg.eigh(bones @ bones.transpose(0, 1))
        self.basis[self.leading :, self.leading :] = vectors.flip(1)
        start, sequence = self.project(posture)[:, self.leading :], self.project(clean)[:, self.leading :]
        weight = (start * sequence).sum(0) / start.square().sum(0).clamp_min(1e-6)
        self.weight[self.leading :] = weight
        self.std[self.leading :] = ((sequence - weight * start) @ self.cosines).square().mean(0).sqrt()

    def project(self, sequence: Sequences) -> Float[Tensor, "batch component frame"]:
        """Return the components of sequences."""
        return self.basis.transpose(0, 1) @ sequence

    def mean(self, posture: Sequences) -> Sequences:
        """Return the expected sequence given a posture."""
        return self.basis @ (self.weight * self.project(posture))

    def coefficients(self, residual: Sequences) -> Float[Tensor, "batch component frequency"]:
        """Return the coefficients of noisy sequences less their mean given the posture."""
        return self.project(residual) @ self.cosines

    def whitened(
        self, coefficients: Float[Tensor, "batch component frequency"], t: Steps
    ) -> Float[Tensor, "batch corrected frame"]:
        """Return the leading components with unit variance at every step, frame and frequency."""
        leading = coefficients[:, : self.corrected] / self.noisy_std(t)[:, : self.corrected]
        return leading @ self.cosines.transpose(0, 1)

    def noise(
        self,
        coefficients: Float[Tensor, "batch component frequency"],
        velocity: Float[Tensor, "batch corrected frame"],
        t: Steps,
    ) -> Sequences:
        """Return the noise in sequences: its best linear estimate, corrected by a predicted velocity in the
        units of `whitened`.
        """
        noisy_std = self.noisy_std(t)
        correction = self.signal[t.long()][:, None, None] * (self.std / noisy_std)[:, : self.corrected]
        correction = correction * (velocity.to(coefficients.dtype) @ self.cosines)
        linear = self.sigma[t.long()][:, None, None] / noisy_std.square() * coefficients
        corrected = torch.cat([linear[:, : self.corrected] + correction, linear[:, self.corrected :]], dim=1)
        return self.basis @ (corrected @ self.cosines.transpose(0, 1))

    def noisy_std(self, t: Float[Tensor, "batch"]) -> Float[Tensor, "batch component frequency"]:
        """Return the standard deviation of the noisy coefficients."""
        signal, sigma = self.signal[t.long()][:, None, None], self.sigma[t.long()][:, None, None]
        return (signal.square() * self.std.square() + sigma.square()).sqrt()


class BodyDenoiser(nn.Module):
    """Denoise a body along a path as the residual from what the prior expects given its current posture.

    The last channels of the condition are the posture, scaled as the body is except for the root rotation;
    zeros if the past is dropped. With x_t = sqrt(alpha_bar) clean + sqrt(1 - alpha_bar) noise, subtracting
    sqrt(alpha_bar) times the expectation leaves the noise unchanged.
    """

    path_std: Tensor
    root_mean: Tensor
    root_std: Tensor
    rotation_std: Tensor
    sqrt_alpha_bar: Tensor
    causal_mask: Tensor

    def __init__(
        self,
        unet: SequenceDenoiser,
        prior: GaussianPrior,
        posture_channels: int,
        frames: int,
        schedule: Schedule = STANDARD,
        rate_hz: float = RATE_HZ,
    ):
        super().__init__()
        self.unet, self.prior = unet, prior
        self.posture_channels, self.rate_hz = posture_channels, rate_hz
        self.register_buffer("path_std", torch.ones(3, frames))
        self.register_buffer("root_mean", torch.zeros(ROOT_CHANNELS))
        self.register_buffer("root_std", torch.ones(ROOT_CHANNELS))
        self.register_buffer("rotation_std", torch.ones(ROOT_CHANNELS))
        sqrt_alpha_bar = torch.from_numpy(schedule.alpha_bar).float().sqrt()
        self.register_buffer("sqrt_alpha_bar", sqrt_alpha_bar, persistent=False)
        self.register_buffer("causal_mask", torch.ones(frames, frames).tril(), persistent=False)

    def forward(self, x: Sequences, t: Steps, condition: Conditions, control: Paths, keep: Keep) -> Sequences:
        posture, step, heading = self.posture(x, t, condition, control)
        expected = self.sqrt_alpha_bar[t.long()][:, None, None] * self.prior.mean(posture)
        coefficients = self.prior.coefficients(x - expected)
        unet_control = torch.cat([control, step * self.rate_hz, heading], dim=1)
        whitened = self.prior.whitened(coefficients, t)
        output = self.unet.velocity(whitened, t, condition, unet_control, keep)
        return self.prior.noise(coefficients, self.gated(output, whitened), t)

    def gated(
        self, output: Float[Tensor, "batch output frame"], whitened: Float[Tensor, "batch corrected frame"]
    ) -> Float[Tensor, "batch corrected frame"]:
        """Return the velocity; outputs beyond it are gates, which multiply the noisy components of bones.

        A resting animal moves its bones less than the prior expects, a walking one more. A gate says by how
        much for each frame and component, which a narrow UNet cannot by outputs of its own.
        """
        velocity = output[:, : self.prior.corrected]
        gate = output[:, self.prior.corrected :]
        if not gate.shape[1]:
            return velocity
        bones = velocity[:, self.prior.leading :] + gate * whitened[:, self.prior.leading :]
        return torch.cat([velocity[:, : self.prior.leading], bones], dim=1)

    def posture(
        self, x: Sequences, t: Steps, condition: Conditions, control: Paths
    ) -> tuple[Sequences, Float[Tensor, "batch 3 frame"], Float[Tensor, "batch 2 frame"]]:
        """Return the current posture in every frame, rotated to the heading; displacements; headings."""
        posture = condition[:, -self.posture_channels :, None].expand(-1, -1, x.shape[-1])
        root = posture[:, :ROOT_CHANNELS] * self.root_std[:, None] + self.root_mean[:, None]
        step = self.steps(x, t, control)
        heading = self.headings(step, root)
        root = (rotated_to_heading(root, heading) - self.root_mean[:, None]) / self.rotation_std[:, None]
        posture = torch.cat([root, posture[:, ROOT_CHANNELS:]], dim=1)
        posture = nn.functional.pad(posture, (0, 0, x.shape[1] - self.posture_channels, 0))
        return posture, step, heading

    def steps(self, x: Sequences, t: Steps, control: Paths) -> Float[Tensor, "batch 3 frame"]:
        """Return the displacement per frame, meters; the first frame repeats the second."""
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
        exponentially with the distance traveled since.
        """
        horizontal = step[:, ::2]
        square = horizontal.square().sum(1, keepdim=True)
        horizontal = horizontal * (square / (square + PATH_NOISE_M**2))
        traveled = (horizontal.square().sum(1) + 1e-12).sqrt().cumsum(-1)
        since = (traveled[:, None, :] - traveled[:, :, None]).clamp(max=0)
        displacement = horizontal @ (torch.exp(since / HEADING_MEMORY_M) * self.causal_mask).transpose(-1, -2)
        return soft_unit(
            displacement
            + HEADING_MEMORY_M * torch.exp(-traveled / HEADING_MEMORY_M)[:, None] * horizontal_forward(root)
        )


class OneStageDenoiser(BodyDenoiser):
    """Denoise path and body as one sequence, path channels first; the heading is that of the noisy path."""

    velocity_std: Tensor

    def __init__(self, *arguments: Any, **options: Any):
        super().__init__(*arguments, **options)
        self.register_buffer("velocity_std", torch.ones(PATH_CHANNELS))

    def steps(self, x: Sequences, t: Steps, control: Paths) -> Float[Tensor, "batch 3 frame"]:
        """Return the expected displacement per frame given the noisy path, meters."""
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
    """Return vectors normalized to about length 1; shorter where the direction is ill-defined."""
    return vector / (vector.square().sum(1, keepdim=True) + MIN_DIRECTION**2).sqrt()
