"""Diffusion in 50 steps: schedules, noising, DDPM and DDIM sampling, classifier-free guidance.

Arithmetic only, on NumPy arrays and torch tensors alike: `sample` takes any function that predicts the noise,
be it a torch module, an ONNX session, or a guided pair of calls.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, TypeVar, assert_never

import numpy as np
from jaxtyping import Float
from torch import Tensor

from pipeline.behavior.config import NoiseCourse, SamplingMethod

Array = TypeVar("Array", np.ndarray, Tensor)


@dataclass(frozen=True)
class Schedule:
    """How much noise each step holds."""

    steps: int = 50
    """noise levels"""
    beta_first: float = 1e-4
    """variance added at the first step, where it is linear"""
    beta_last: float = 0.2
    """variance added at the last step, where it is linear"""
    clip: float = 5.0
    """bound of the clean estimate, in standard deviations"""
    course: NoiseCourse = "linear"
    """variances that grow linearly (Ho et al. 2020), or rectified flow (Liu et al. 2023): straight ways (1 -
    s) clean + s noise, scaled to unit variance, which DDIM follows in Euler's steps; learn it with
    `weighting` "flow\""""

    @property
    def method(self) -> Literal["ddpm", "ddim"]:
        """Return how goals are best drawn (measured on homes kept from training)."""
        return "ddim" if self.course == "rectified" else "ddpm"

    @property
    def beta(self) -> Float[np.ndarray, "step"]:
        """Variance added at each step (beta_t of Ho et al. 2020)."""
        return np.linspace(self.beta_first, self.beta_last, self.steps)

    @property
    def alpha_bar(self) -> Float[np.ndarray, "step"]:
        """Share of the clean signal's variance left after each step."""
        match self.course:
            case "linear":
                return np.cumprod(1.0 - self.beta)
            case "rectified":
                noise = np.arange(1, self.steps + 1) / (self.steps + 1)
                return (1 - noise) ** 2 / ((1 - noise) ** 2 + noise**2)
            case _:
                assert_never(self.course)

    def visited(self, count: int) -> list[int]:
        """Return the steps that a sampler of ``count`` steps visits, noisiest first."""
        return [int(np.floor(t + 0.5)) for t in np.linspace(self.steps - 1, 0, count)]


STANDARD = Schedule()
"""50 linear steps, as in the paper"""


def noised(clean: Array, noise: Array, alpha_bar: Array) -> Array:
    """Return x_t = sqrt(alpha_bar) clean + sqrt(1 - alpha_bar) noise; ``alpha_bar`` broadcasts."""
    return alpha_bar**0.5 * clean + (1 - alpha_bar) ** 0.5 * noise


def guided(
    denoisers: Sequence[Callable[[Array, float], Array]], scales: Sequence[float]
) -> Callable[[Array, float], Array]:
    """Return e_n + sum over i of scale_i (e_i - e_i+1), where each denoiser knows one thing less than the
    one before it; those that cancel out are not called.
    """
    known = (*scales[: len(denoisers) - 1], 1.0)
    weights = np.diff(known, prepend=0.0)
    called = [(float(w), each) for w, each in zip(weights, denoisers, strict=True) if w]

    def mixed(x: Array, t: float) -> Array:
        *others, (_, last) = called
        reference = last(x, t)
        return sum((weight * (each(x, t) - reference) for weight, each in others), start=reference)

    return mixed


def sample(
    denoise: Callable[[Array, float], Array],
    noise: Array,
    schedule: Schedule,
    *,
    method: SamplingMethod,
    count: int,
    draw: Callable[[], Array] | None = None,
    correct: Callable[[Array], Array] | None = None,
) -> Array:
    """Turn ``noise`` into a sample in ``count`` steps.

    ``denoise(x, t)`` predicts the noise. DDIM is deterministic; DDPM adds fresh noise from ``draw`` at each
    step but the last, with the posterior variance of the steps visited (exact ancestral sampling when all
    are) or, as `ddpm_large`, with that of the forward steps, which is exact for data of N(0, 1).
    ``correct`` is applied to the clean estimates of the steps at which most of the variance is clean, the
    last one among them.
    """
    x, steps, alpha_bar = noise, schedule.visited(count), schedule.alpha_bar
    for position, t in enumerate(steps):
        now = float(alpha_bar[t])
        epsilon = denoise(x, float(t))
        clean = ((x - (1 - now) ** 0.5 * epsilon) / now**0.5).clip(-schedule.clip, schedule.clip)
        epsilon = (x - now**0.5 * clean) / (1 - now) ** 0.5
        clean = correct(clean) if correct and now > 0.5 else clean
        if position == len(steps) - 1:
            return clean
        later = float(alpha_bar[steps[position + 1]])
        beta = 1 - now / later
        posterior = (1 - later) / (1 - now) * beta
        match method:
            case "ddpm":
                replaced, fresh = posterior, posterior
            case "ddpm_large":
                replaced, fresh = posterior, beta
            case "ddim":
                replaced, fresh = 0.0, 0.0
            case _:
                assert_never(method)
        x = later**0.5 * clean + max(1 - later - replaced, 0.0) ** 0.5 * epsilon
        if fresh:
            assert draw is not None, "DDPM draws fresh noise"
            x = x + fresh**0.5 * draw()
    return x
