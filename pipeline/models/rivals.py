"""Samplers of the rival models of Table 4, which share networks, training and perception with ours.

`GaussianSampler`: the networks tell mean and spread, once each, of goal, path and body (Kendall & Gal 2017); the mean of
one level steers the next. `OneStageSampler`: path and body are denoised as one sequence, with no goal before them (Tevet
et al. 2022). `sampler_of` chooses by the architecture.
"""

from dataclasses import dataclass
from typing import assert_never

import numpy as np
from jaxtyping import Float

from pipeline.models.behavior import Architecture, Sampling, Scaling
from pipeline.models.diffusion import Schedule
from pipeline.models.planning import Array, Codes, Networks, Plan, Sampler
from pipeline.models.strides import STRIDE

MEAN, SPREAD = 0.0, 1.0
"""Steps at which a Gaussian's networks, shown no sample, tell its mean and the logarithm of its standard deviation."""
LOG_STD = (-5.0, 2.0)
"""Bounds of that logarithm."""


def sampler_of(architecture: Architecture, networks: Networks, schedule: Schedule, scaling: Scaling) -> Sampler:
    """Return the sampler that draws plans from networks of this kind."""
    match architecture.family:
        case "diffusion":
            return Sampler(networks, schedule, scaling)
        case "one_stage":
            return OneStageSampler(networks, schedule, scaling)
        case "gaussian":
            return GaussianSampler(networks, schedule, scaling)
        case _:
            assert_never(architecture.family)


@dataclass(frozen=True)
class GaussianSampler(Sampler):
    """Draws from Gaussians, each number on its own."""

    def planned(self, codes: Codes, sampling: Sampling, rng: np.random.Generator, goal: Array | None, path: Array | None) -> Plan:
        """Draw plans; the means lead from level to level."""
        towards = self.scaling.goal(self._goal(codes)[0]) if goal is None else goal
        along = self.scaling.path(self._path(codes, towards, sampling)[0], codes.start) if path is None else path
        goal = self.goals(codes, sampling, rng) if goal is None else goal
        path = self.paths(codes, towards, sampling, rng) if path is None else path
        return Plan(goal, path, self.bodies(codes, along, sampling, rng))

    def led(self, codes: Codes, sampling: Sampling, rng: np.random.Generator) -> Float[np.ndarray, "plan frame 3"]:
        """Draw paths to the mean goal."""
        return self.paths(codes, self.scaling.goal(self._goal(codes)[0]), sampling, rng)

    def goals(self, codes: Codes, sampling: Sampling, rng: np.random.Generator) -> Float[np.ndarray, "plan 3"]:
        """Draw goals in the ego frame, metres."""
        return self.scaling.goal(self.goals_cleared(codes, self._drawn_from(self._goal(codes), rng)))

    def walked(
        self, codes: Codes, goal: Float[np.ndarray, "plan 3"], sampling: Sampling, rng: np.random.Generator
    ) -> Float[np.ndarray, "plan frame 3"]:
        """Draw a path towards each goal."""
        return self.paths_finished(codes, self._drawn_from(self._path(codes, goal, sampling), rng), goal, sampling)

    def bodies(
        self, codes: Codes, path: Float[np.ndarray, "plan frame 3"], sampling: Sampling, rng: np.random.Generator
    ) -> Float[np.ndarray, "plan frame channel"]:
        """Draw bodies along paths."""
        control = self.scaling.told_path(path)
        nothing = np.zeros((len(path), len(self.scaling.body_mean), path.shape[1]), np.float32)
        told = [self.networks.body(nothing, _step(nothing, t), codes.full, control, _kept(nothing, 1.0)) for t in (MEAN, SPREAD)]
        return np.swapaxes(self._drawn_from(told, rng, sampling.body_spread), 1, 2) * self.scaling.body_std + self.scaling.body_mean

    def _goal(self, codes: Codes) -> list[Array]:
        nothing = np.zeros((len(codes.full), 3), np.float32)
        return [self.networks.goal(nothing, _step(nothing, t), codes.full) for t in (MEAN, SPREAD)]

    def _path(self, codes: Codes, goal: Float[np.ndarray, "plan 3"], sampling: Sampling) -> list[Array]:
        control = self.scaling.scaled_goal(goal)
        nothing = np.zeros((len(goal), STRIDE, self.scaling.path_std.shape[1]), np.float32)
        keep = _kept(nothing, float(sampling.goal))
        return [self.networks.path(nothing, _step(nothing, t), codes.full, control, keep) for t in (MEAN, SPREAD)]

    def _drawn_from(self, told: list[Array], rng: np.random.Generator, spread: float = 1.0) -> Array:
        mean, log_std = told
        return mean + spread * np.exp(np.clip(log_std, *LOG_STD)) * rng.standard_normal(mean.shape, dtype=np.float32)


@dataclass(frozen=True)
class OneStageSampler(Sampler):
    """Draws path and body together; the goal is where the path ends."""

    def planned(self, codes: Codes, sampling: Sampling, rng: np.random.Generator, goal: Array | None, path: Array | None) -> Plan:
        """Draw plans. A given goal or path cannot steer a model without stages."""
        assert goal is None and path is None, "a one-stage model takes no goal and no path"
        whole = self._whole(codes, sampling, rng)
        path = self._path(codes, whole)
        body = np.swapaxes(whole[:, STRIDE:], 1, 2) * self.scaling.body_std + self.scaling.body_mean
        return Plan(path[:, -1], path, body)

    def led(self, codes: Codes, sampling: Sampling, rng: np.random.Generator) -> Float[np.ndarray, "plan frame 3"]:
        """Draw whole plans and keep the paths."""
        return self.planned(codes, sampling, rng, None, None).path

    def goals(self, codes: Codes, sampling: Sampling, rng: np.random.Generator) -> Float[np.ndarray, "plan 3"]:
        """Draw whole plans and keep where they end."""
        return self._path(codes, self._whole(codes, sampling, rng))[:, -1]

    def _path(self, codes: Codes, whole: Array) -> Float[np.ndarray, "plan frame 3"]:
        return codes.kept(self.scaling.path(whole[:, :STRIDE], codes.start))

    def _whole(self, codes: Codes, sampling: Sampling, rng: np.random.Generator) -> Array:
        frames = self.scaling.path_std.shape[1]
        control = np.zeros((len(codes.full), 3, frames), np.float32)

        def denoise(code: Array):
            return lambda x, t: self.networks.body(x, _step(x, t), code, control, _kept(x, 0.0))

        def correct(x: Array) -> Array:
            return np.concatenate([self.paths_cleared(codes, x[:, :STRIDE]), x[:, STRIDE:]], axis=1)

        shape = (len(codes.full), STRIDE + len(self.scaling.body_mean), frames)
        spread = np.array([1.0] * STRIDE + [sampling.body_spread] * len(self.scaling.body_mean))[:, None]
        return self._drawn(denoise(codes.full), denoise(codes.blind), shape, sampling, sampling.sequence_steps, rng, correct, spread)


def _step(x: Array, t: float) -> Array:
    return np.full(len(x), t, np.float32)


def _kept(x: Array, keep: float) -> Array:
    return np.full((len(x), 1), keep, np.float32)
