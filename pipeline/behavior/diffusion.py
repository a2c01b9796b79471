"""Diffusion in 50 steps: schedules, noising, samplers (DDPM, DPM-Solver++), classifier-free guidance.

Works on NumPy arrays and torch tensors alike: `sample` takes any function that predicts the noise, such as a
torch module, an ONNX session, or a guided combination of calls.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, TypeVar, assert_never

import numpy as np
from jaxtyping import Float
from torch import Tensor

from pipeline.behavior.config import NoiseCourse, SamplingMethod

Array = TypeVar("Array", np.ndarray, Tensor)

SOLVER_STEPS = 10
"""sampling steps of DPM-Solver++"""


@dataclass(frozen=True)
class Schedule:
    """Noise schedule."""

    steps: int = 50
    """noise levels"""
    beta_first: float = 1e-4
    """beta of the first step of the linear schedule"""
    beta_last: float = 0.2
    """beta of the last step of the linear schedule"""
    clip: float = 5.0
    """clipping bound of the clean estimate, in standard deviations"""
    course: NoiseCourse = "linear"
    """variances that grow linearly (Ho et al. 2020), or rectified flow (Liu et al. 2023): straight lines (1 -
    s) clean + s noise, scaled to unit variance; train it with `weighting` "flow\""""
    method: SamplingMethod = "dpm_solver"
    """sampler, unless a caller chooses"""

    @property
    def sampled_steps(self) -> int:
        """Return the default number of sampling steps."""
        return SOLVER_STEPS if self.method == "dpm_solver" else self.steps

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

    @property
    def log_snr(self) -> Float[np.ndarray, "step"]:
        """Half the logarithm of the signal-to-noise ratio of each step."""
        return np.log(self.alpha_bar / (1 - self.alpha_bar)) / 2

    def visited(self, count: int, method: SamplingMethod) -> list[int]:
        """Return the steps that a sampler visits, noisiest first: evenly spaced, or for `dpm_solver` at most
        ``count`` of them, evenly spaced in the logarithm of the signal-to-noise ratio.
        """
        if method != "dpm_solver":
            return [int(np.floor(t + 0.5)) for t in np.linspace(self.steps - 1, 0, count)]
        wanted = np.linspace(self.log_snr[-1], self.log_snr[0], count)
        nearest = np.abs(self.log_snr - wanted[:, None]).argmin(axis=1)
        return sorted({int(t) for t in nearest}, reverse=True)


STANDARD = Schedule()
"""50 linear steps, as in the paper"""


def noised(clean: Array, noise: Array, alpha_bar: Array) -> Array:
    """Return x_t = sqrt(alpha_bar) clean + sqrt(1 - alpha_bar) noise; ``alpha_bar`` broadcasts."""
    return alpha_bar**0.5 * clean + (1 - alpha_bar) ** 0.5 * noise


def guided(
    denoisers: Sequence[Callable[[Array, float], Array]], scales: Sequence[Any]
) -> Callable[[Array, float], Array]:
    """Return the guided noise e_n + sum over i of scale_i (e_i - e_i+1); each denoiser has one condition less
    than the one before it. Scales may be arrays that broadcast. Denoisers of weight 0 are not called.
    """
    cumulative = (0.0, *scales[: len(denoisers) - 1], 1.0)
    weights: list[Any] = [scale - before for before, scale in pairwise(cumulative)]
    called = [(w, each) for w, each in zip(weights, denoisers, strict=True) if np.any(w)]

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
    """Turn ``noise`` into a sample in ``count`` steps (`Schedule.visited`).

    ``denoise(x, t)`` predicts the noise. DDPM adds fresh noise from ``draw`` at each step but the last, with
    the posterior variance of the steps visited (exact ancestral sampling if all are) or, as `ddpm_large`,
    with the forward variance, which is exact for data of N(0, 1). `dpm_solver`, deterministic, is
    DPM-Solver++ (2M) of Lu et al. 2022: DDIM with clean estimates extrapolated from the previous step, except
    before the last; in ten steps it keeps the variance that DDIM loses. ``correct`` is applied to the clean
    estimate of every step with alpha_bar above 0.5, including the last.
    """
    x, steps, alpha_bar = noise, schedule.visited(count, method), schedule.alpha_bar
    stride, earlier = np.diff(schedule.log_snr[steps]), None
    for position, t in enumerate(steps):
        alpha_bar_t = float(alpha_bar[t])
        epsilon = denoise(x, float(t))
        estimate = (x - (1 - alpha_bar_t) ** 0.5 * epsilon) / alpha_bar_t**0.5
        estimate = estimate.clip(-schedule.clip, schedule.clip)
        clean = correct(estimate) if correct and alpha_bar_t > 0.5 else estimate
        if position == len(steps) - 1:
            return clean
        alpha_bar_next = float(alpha_bar[steps[position + 1]])
        beta = 1 - alpha_bar_t / alpha_bar_next
        posterior = (1 - alpha_bar_next) / (1 - alpha_bar_t) * beta
        removed, added, ahead = 0.0, 0.0, 0.0
        match method:
            case "ddpm":
                removed, added = posterior, posterior
            case "ddpm_large":
                removed, added = posterior, beta
            case "dpm_solver":
                if earlier is not None and position < len(steps) - 2:
                    ahead = float(stride[position] / stride[position - 1] / 2) * (clean - earlier)
                earlier = clean
            case _:
                assert_never(method)
        epsilon = (x - alpha_bar_t**0.5 * (estimate + ahead)) / (1 - alpha_bar_t) ** 0.5
        x = alpha_bar_next**0.5 * (clean + ahead) + max(1 - alpha_bar_next - removed, 0.0) ** 0.5 * epsilon
        if added:
            assert draw is not None, "DDPM draws fresh noise"
            x = x + added**0.5 * draw()
    return x
