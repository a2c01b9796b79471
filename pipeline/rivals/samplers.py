"""Samplers of the rival models of Table 4, which share networks, training and perception with ours.

`GaussianSampler`: the networks predict mean and standard deviation, once each, of goal, path and body
(Kendall & Gal 2017); the mean of one level steers the next. `OneStageSampler`: path and body are denoised as
one sequence, with no goal before them (Tevet et al. 2022). `sampler_of` chooses by the architecture.
"""

from dataclasses import dataclass
from typing import assert_never

import numpy as np
from jaxtyping import Float

from pipeline.behavior.config import PlanSamplingConfig
from pipeline.behavior.diffusion import Schedule
from pipeline.behavior.model import Architecture, Scaling
from pipeline.behavior.path_encoding import PATH_CHANNELS
from pipeline.behavior.planning import Array, Networks, PlanCondition, SampledPlan, Sampler

MEAN_STEP, LOG_STD_STEP = 0.0, 1.0
"""Steps at which a Gaussian's networks, shown no sample, predict its mean and the logarithm of its standard
deviation."""
LOG_STD_BOUNDS = (-5.0, 2.0)
"""Bounds of that logarithm."""


def sampler_of(
    architecture: Architecture, networks: Networks, schedule: Schedule, scaling: Scaling
) -> Sampler:
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

    def draw_plans(
        self,
        codes: PlanCondition,
        sampling: PlanSamplingConfig,
        rng: np.random.Generator,
        goal: Array | None,
        path: Array | None,
    ) -> SampledPlan:
        """Draw plans; the means lead from level to level."""
        towards = self.scaling.goal(self._goal(codes)[0]) if goal is None else goal
        along = path
        if along is None:
            along = self.scaling.path(self._path(codes, towards, sampling)[0], codes.start)
        goal = self.goals(codes, sampling, rng) if goal is None else goal
        path = self.paths(codes, towards, sampling, rng) if path is None else path
        return SampledPlan(goal, path, self.bodies(codes, along, sampling, rng))

    def draw_plan_paths(
        self, codes: PlanCondition, sampling: PlanSamplingConfig, rng: np.random.Generator
    ) -> Float[np.ndarray, "plan frame 3"]:
        """Draw paths to the mean goal, metres, ego frame."""
        return self.paths(codes, self.scaling.goal(self._goal(codes)[0]), sampling, rng)

    def goals(
        self, codes: PlanCondition, sampling: PlanSamplingConfig, rng: np.random.Generator
    ) -> Float[np.ndarray, "plan 3"]:
        """Draw goals in the ego frame, metres."""
        return codes.on_support(self.scaling.goal(self._drawn_from(self._goal(codes), rng)))

    def draw_paths(
        self,
        codes: PlanCondition,
        goal: Float[np.ndarray, "plan 3"],
        sampling: PlanSamplingConfig,
        rng: np.random.Generator,
    ) -> Float[np.ndarray, "plan frame 3"]:
        """Draw a path towards each goal, metres, ego frame."""
        scaled = self._drawn_from(self._path(codes, goal, sampling), rng, sampling.path_noise_std)
        return self.decode_paths(codes, scaled, goal, sampling)

    def bodies(
        self,
        codes: PlanCondition,
        path: Float[np.ndarray, "plan frame 3"],
        sampling: PlanSamplingConfig,
        rng: np.random.Generator,
    ) -> Float[np.ndarray, "plan frame channel"]:
        """Draw bodies along paths, metres and radians, ego frame."""
        control = self.scaling.scaled_path(path)
        nothing = np.zeros((len(path), len(self.scaling.body_mean), path.shape[1]), np.float32)
        outputs = [
            self.networks.body(nothing, _step(nothing, t), codes.full, control, _keep_mask(nothing, 1.0))
            for t in (MEAN_STEP, LOG_STD_STEP)
        ]
        scaled = np.swapaxes(self._drawn_from(outputs, rng, sampling.body_noise_std), 1, 2)
        return scaled * self.scaling.body_std + self.scaling.body_mean

    def _goal(self, codes: PlanCondition) -> list[Array]:
        nothing = np.zeros((len(codes.full), 3), np.float32)
        return [self.networks.goal(nothing, _step(nothing, t), codes.full) for t in (MEAN_STEP, LOG_STD_STEP)]

    def _path(
        self, codes: PlanCondition, goal: Float[np.ndarray, "plan 3"], sampling: PlanSamplingConfig
    ) -> list[Array]:
        control = self.scaling.scaled_goal(goal)
        nothing = np.zeros((len(goal), PATH_CHANNELS, self.scaling.path_std.shape[1]), np.float32)
        keep = _keep_mask(nothing, float(sampling.goal))
        return [
            self.networks.path(nothing, _step(nothing, t), codes.full, control, keep)
            for t in (MEAN_STEP, LOG_STD_STEP)
        ]

    def _drawn_from(self, outputs: list[Array], rng: np.random.Generator, spread: float = 1.0) -> Array:
        mean, log_std = outputs
        noise = rng.standard_normal(mean.shape, dtype=np.float32)
        return mean + spread * np.exp(np.clip(log_std, *LOG_STD_BOUNDS)) * noise


@dataclass(frozen=True)
class OneStageSampler(Sampler):
    """Draws path and body together; the goal is where the path ends."""

    def draw_plans(
        self,
        codes: PlanCondition,
        sampling: PlanSamplingConfig,
        rng: np.random.Generator,
        goal: Array | None,
        path: Array | None,
    ) -> SampledPlan:
        """Draw plans. A given goal or path cannot steer a model without stages."""
        assert goal is None and path is None, "a one-stage model takes no goal and no path"
        whole = self._whole(codes, sampling, rng)
        path = self._path(codes, whole)
        body = np.swapaxes(whole[:, PATH_CHANNELS:], 1, 2) * self.scaling.body_std + self.scaling.body_mean
        return SampledPlan(path[:, -1], path, body)

    def draw_plan_paths(
        self, codes: PlanCondition, sampling: PlanSamplingConfig, rng: np.random.Generator
    ) -> Float[np.ndarray, "plan frame 3"]:
        """Draw whole plans and keep the paths, metres, ego frame."""
        return self.draw_plans(codes, sampling, rng, None, None).path

    def goals(
        self, codes: PlanCondition, sampling: PlanSamplingConfig, rng: np.random.Generator
    ) -> Float[np.ndarray, "plan 3"]:
        """Draw whole plans and keep where they end."""
        return self._path(codes, self._whole(codes, sampling, rng))[:, -1]

    def _path(self, codes: PlanCondition, whole: Array) -> Float[np.ndarray, "plan frame 3"]:
        path = self.scaling.path(whole[:, :PATH_CHANNELS], codes.start)
        return codes.constrained(path, self.scaling.rate_hz)

    def _whole(self, codes: PlanCondition, sampling: PlanSamplingConfig, rng: np.random.Generator) -> Array:
        frames = self.scaling.path_std.shape[1]
        control = np.zeros((len(codes.full), 3, frames), np.float32)

        def denoise(code: Array):
            return lambda x, t: self.networks.body(x, _step(x, t), code, control, _keep_mask(x, 0.0))

        def correct(x: Array) -> Array:
            path = self.paths_out_of_solid(codes, x[:, :PATH_CHANNELS])
            return np.concatenate([path, x[:, PATH_CHANNELS:]], axis=1)

        body = len(self.scaling.body_mean)
        shape, steps = (len(codes.full), PATH_CHANNELS + body, frames), sampling.sequence_steps
        stds = sampling.path_noise_std, sampling.body_noise_std
        spread = np.repeat(stds, (PATH_CHANNELS, body))[:, None]
        denoisers = [denoise(code) for code in (codes.full, *codes.references)]
        return self._denoised(denoisers, shape, sampling, steps, rng, correct, spread)


def _step(x: Array, t: float) -> Array:
    return np.full(len(x), t, np.float32)


def _keep_mask(x: Array, keep: float) -> Array:
    return np.full((len(x), 1), keep, np.float32)
