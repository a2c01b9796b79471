"""Denoising networks of sequences: 1-D ControlUNets for path and body (Eq. 9, 10), and shared layers.

All predict the noise in x at step t, given the perception code. Their outputs are v-predictions, v =
sqrt(alpha_bar) noise - sqrt(1 - alpha_bar) clean (Salimans & Ho 2022), which have unit scale at every step;
`NoiseFromVelocity` converts v to noise, so that an output of 0 is the best linear predictor. A ControlUNet is
two identical UNets: the main branch denoises; the control branch (ControlNet) reads the control, goal or
path, and adds its features to every block of the main branch.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor, nn

from pipeline.behavior.diffusion import STANDARD, Schedule

TIME_CHANNELS, EMBEDDING = 64, 128
Sequences = Float[Tensor, "batch channel frame"]
"""Scaled channels over frames"""
Steps = Float[Tensor, "batch"]
"""Steps of the diffusion schedule"""
Conditions = Float[Tensor, "batch condition"]
"""Perception codes, and what else a level reads"""
Controls = Float[Tensor, "batch control"] | Float[Tensor, "batch control frame"]
"""The level above: a scaled goal, or a scaled path"""
Keep = Float[Tensor, "batch 1"]
"""1, or 0 to drop the control"""


def time_embedding(t: Float[Tensor, "batch"]) -> Float[Tensor, "batch 64"]:
    """Return the sinusoidal embedding of the step at 32 frequencies from 1 down to 1e-4."""
    number = torch.arange(TIME_CHANNELS // 2, dtype=torch.float32, device=t.device)
    angle = t[:, None] * torch.exp(-math.log(1e4) / (TIME_CHANNELS // 2) * number)
    return torch.cat([angle.sin(), angle.cos()], dim=-1)


class NoiseFromVelocity(nn.Module):
    """Convert a predicted velocity and the noisy sample to the noise."""

    sigma: Tensor
    alpha: Tensor

    def __init__(self, schedule: Schedule):
        super().__init__()
        alpha_bar = torch.from_numpy(schedule.alpha_bar).float()
        self.register_buffer("sigma", (1 - alpha_bar).sqrt(), persistent=False)
        self.register_buffer("alpha", alpha_bar.sqrt(), persistent=False)

    def forward(
        self, x: Float[Tensor, "batch ..."], velocity: Float[Tensor, "*stack"], t: Steps
    ) -> Float[Tensor, "*stack"]:
        step, shape = t.long(), (-1, *[1] * (x.ndim - 1))
        return self.sigma[step].reshape(shape) * x + self.alpha[step].reshape(shape) * velocity


class TrailingLinear(nn.Linear):
    """A linear layer on the last ``in_features`` channels of the condition, which follow the maps."""

    def forward(self, row: Float[Tensor, "batch number"]) -> Float[Tensor, "batch out"]:
        return super().forward(row[:, -self.in_features :])


class Embedding(nn.Module):
    """The embedding of step and code that conditions every block; ``read`` projects the code."""

    def __init__(self, read: nn.Module):
        super().__init__()
        self.time = nn.Sequential(
            nn.Linear(TIME_CHANNELS, EMBEDDING), nn.SiLU(), nn.Linear(EMBEDDING, EMBEDDING)
        )
        self.read = read

    def forward(self, t: Steps, code: Float[Tensor, "batch code"]) -> Float[Tensor, "batch 128"]:
        return nn.functional.silu(self.time(time_embedding(t)) + self.read(code))


class TemporalBlock(nn.Module):
    """Residual block: two temporal convolutions with group norm, the embedding added between them."""

    def __init__(self, inner: int, outer: int, embedding: int):
        super().__init__()
        self.first = nn.Sequential(nn.Conv1d(inner, outer, 5, 1, 2), nn.GroupNorm(8, outer), nn.SiLU())
        self.second = nn.Sequential(nn.Conv1d(outer, outer, 5, 1, 2), nn.GroupNorm(8, outer), nn.SiLU())
        self.embedding = nn.Linear(embedding, outer)
        self.shortcut = nn.Conv1d(inner, outer, 1) if inner != outer else nn.Identity()

    def forward(
        self, h: Sequences, embedding: Float[Tensor, "batch e"]
    ) -> Float[Tensor, "batch outer frame"]:
        return self.second(self.first(h) + self.embedding(embedding)[..., None]) + self.shortcut(h)


class UNet1d(nn.Module):
    """A 1-D UNet over frames, whose blocks can take added features of a control branch."""

    def __init__(self, channels: int, widths: tuple[int, ...], embedding: int):
        super().__init__()
        inner = (widths[0], *widths[:-1])
        self.enter = nn.Conv1d(channels, widths[0], 1)
        self.down = nn.ModuleList(TemporalBlock(i, o, embedding) for i, o in zip(inner, widths, strict=True))
        self.halve = nn.ModuleList(nn.Conv1d(w, w, 3, 2, 1) for w in widths[:-1])
        self.middle = TemporalBlock(widths[-1], widths[-1], embedding)
        self.up = nn.ModuleList(
            TemporalBlock(2 * o, i, embedding) for i, o in zip(inner[::-1], widths[::-1], strict=True)
        )
        self.block_widths = (*widths, widths[-1], *inner[::-1])

    def forward(
        self,
        h: Sequences,
        embedding: Float[Tensor, "batch e"],
        added: list[Float[Tensor, "batch _ _"]] | None = None,
    ) -> list[Float[Tensor, "batch _ _"]]:
        """Return the output of every block in order; ``added`` holds one tensor per block."""
        outputs: list[Tensor] = []

        def run(block: nn.Module, h: Tensor) -> Tensor:
            h = block(h, embedding)
            outputs.append(h + added[len(outputs)] if added else h)
            return outputs[-1]

        h = self.enter(h)
        skips = []
        for level, block in enumerate(self.down):
            h = run(block, h)
            skips.append(h)
            h = self.halve[level](h) if level < len(self.halve) else h
        h = run(self.middle, h)
        for level, block in enumerate(self.up):
            h = h if level == 0 else h[..., None].expand(*h.shape, 2).flatten(-2)
            h = run(block, torch.cat([h, skips[-1 - level]], dim=1))
        return outputs


class SequenceDenoiser(nn.Module):
    """Predict the noise in a sequence, from a network that predicts its velocity."""

    def __init__(self, schedule: Schedule):
        super().__init__()
        self.noise = NoiseFromVelocity(schedule)

    def forward(
        self, x: Sequences, t: Steps, condition: Conditions, control: Controls, keep: Keep
    ) -> Sequences:
        return self.noise(x, self.velocity(x, t, condition, control, keep), t)

    def velocity(
        self, x: Sequences, t: Steps, condition: Conditions, control: Controls, keep: Keep
    ) -> Float[Tensor, "batch output frame"]:
        """Return the velocity (v-prediction) in x, then any further outputs; ``keep`` 0 drops the control."""
        raise NotImplementedError


class ControlUNet(SequenceDenoiser):
    """Denoise a sequence given a control sequence or vector."""

    def __init__(
        self,
        channels: int,
        control: int,
        condition: int,
        widths: tuple[int, ...] = (32, 64, 128),
        schedule: Schedule = STANDARD,
        outputs: int | None = None,
    ):
        """``outputs``: if not ``channels``, those of the velocity and further ones (`BodyDenoiser.gated`)."""
        super().__init__(schedule)
        self.embedding = Embedding(TrailingLinear(condition, EMBEDDING))
        self.main = UNet1d(channels, widths, EMBEDDING)
        self.side = UNet1d(control, widths, EMBEDDING)
        self.inject = nn.ModuleList(nn.Conv1d(w, w, 1) for w in self.main.block_widths)
        self.out = nn.Conv1d(widths[0], outputs or channels, 1)
        for parameter in self.inject.parameters():
            nn.init.zeros_(parameter)

    def velocity(
        self, x: Sequences, t: Steps, condition: Conditions, control: Controls, keep: Keep
    ) -> Float[Tensor, "batch output frame"]:
        embedding = self.embedding(t, condition)
        control = control if control.ndim == 3 else control[..., None].expand(-1, -1, x.shape[-1])
        side = self.side(control, embedding)
        added = [inject(h) * keep[..., None] for inject, h in zip(self.inject, side, strict=True)]
        return self.out(self.main(x, embedding, added)[-1])


class UncontrolledUNet(SequenceDenoiser):
    """Denoise a sequence without control; same signature as `ControlUNet`."""

    def __init__(
        self,
        channels: int,
        read: nn.Module,
        widths: tuple[int, ...] = (32, 64, 128),
        schedule: Schedule = STANDARD,
        outputs: int | None = None,
    ):
        """``read`` projects a condition to `EMBEDDING` channels; ``outputs`` as in `ControlUNet`."""
        super().__init__(schedule)
        self.embedding = Embedding(read)
        self.main = UNet1d(channels, widths, EMBEDDING)
        self.out = nn.Conv1d(widths[0], outputs or channels, 1)

    def velocity(
        self, x: Sequences, t: Steps, condition: Conditions, control: Controls, keep: Keep
    ) -> Float[Tensor, "batch output frame"]:
        del control, keep
        return self.out(self.main(x, self.embedding(t, condition))[-1])


class ConcatenationUNet(UncontrolledUNet):
    """The ablation of Table 5: the control is concatenated to the code; same signature as `ControlUNet`."""

    def __init__(
        self,
        channels: int,
        control: int,
        condition: int,
        widths: tuple[int, ...] = (32, 64, 128),
        schedule: Schedule = STANDARD,
        outputs: int | None = None,
    ):
        """``control``: channels of the flattened control, 3 for a goal, 8 or 3 per frame for a path."""
        read = nn.Sequential(
            nn.Linear(condition + control + 1, EMBEDDING), nn.SiLU(), nn.Linear(EMBEDDING, EMBEDDING)
        )
        super().__init__(channels, read, widths, schedule, outputs)
        self.condition = condition

    def velocity(
        self, x: Sequences, t: Steps, condition: Conditions, control: Controls, keep: Keep
    ) -> Float[Tensor, "batch output frame"]:
        code = torch.cat([condition[:, -self.condition :], control.flatten(1) * keep, keep], dim=-1)
        return super().velocity(x, t, code, control, keep)
