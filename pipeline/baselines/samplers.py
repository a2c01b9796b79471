"""Samplers of the baselines of Table 4, which share networks, training and perception with ours.

`GaussianSampler`: the networks regress mean and standard deviation of goal, path (positions) and body
(Kendall & Gal 2017); each level is conditioned on the mean of the one above. `OneStageSampler`: path and body
are denoised as one sequence without a goal (Tevet et al. 2022). `sampler_of` chooses by the architecture.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, assert_never

import numpy as np
from jaxtyping import Float

from pipeline.behavior.config import Ego, PlanSamplingConfig
from pipeline.behavior.diffusion import Schedule
from pipeline.behavior.model import Architecture, Scaling, load
from pipeline.behavior.path_encoding import PATH_CHANNELS_OF
from pipeline.behavior.planning import Array, PlanCondition, SampledPlan, Sampler, TorchNetworks, filled
from pipeline.behavior.trajectories import RATE_HZ
from pipeline.core.errors import InputError

MEAN_STEP, LOG_STD_STEP = 0.0, 1.0
"""Steps at which the networks, given a zero sample, predict mean and log standard deviation."""
LOG_STD_BOUNDS = (-5.0, 2.0)
"""Bounds of the log standard deviation."""
PLANS_AT_ONCE = 512
"""Whole plans that are sampled at once where only their goals are wanted; bounds the memory."""


def sampler_of(
    architecture: Architecture, networks: TorchNetworks, schedule: Schedule, scaling: Scaling
) -> Sampler:
    """Return the sampler for the architecture's family."""
    settings = networks, schedule, scaling, architecture.guided, architecture.corrections
    match architecture.family:
        case "diffusion":
            return Sampler(*settings)
        case "one_stage":
            return OneStageSampler(*settings)
        case "gaussian":
            return GaussianSampler(*settings)
        case _:
            assert_never(architecture.family)


def load_playable(model: Path, device: str) -> tuple[Sampler, Ego]:
    """Read a trained model (`behavior/`) that animals live by, and its ego frame. Raises what `load` raises,
    SIM-006 for models whose plans cannot be chained or have another rate than players.
    """
    architecture, nets, scaling, schedule, _ = load(model)
    if architecture.family != "diffusion":
        what = f"plans of the family {architecture.family} cannot be chained"
        raise InputError("SIM-006", what, str(model), "give a model of the family diffusion")
    if architecture.rate_hz != RATE_HZ:
        what = f"plans of {architecture.rate_hz:g} frames a second cannot be played"
        raise InputError("SIM-006", what, str(model), f"give a model of {RATE_HZ} frames a second")
    return sampler_of(architecture, TorchNetworks(nets, device), schedule, scaling), architecture.ego


@dataclass(frozen=True)
class GaussianSampler(Sampler):
    """Samples from Gaussians with independent channels."""

    def draw_plans(
        self, codes: PlanCondition, rng: np.random.Generator, goal: Array | None, path: Array | None
    ) -> SampledPlan:
        """Draw plans; each level is conditioned on the mean of the one above."""
        towards = self.scaling.goal(self._goal(codes)[0]) if goal is None else goal
        along = path
        if along is None:
            along = self.scaling.path_of_scaled(self._path(codes, towards)[0][:, :3])
        goal = self.goals(codes, rng) if goal is None else goal
        path = self.paths(codes, towards, rng) if path is None else path
        return SampledPlan(goal, path, self.bodies(codes, along, rng))

    def plan_paths(self, codes: PlanCondition, rng: np.random.Generator) -> Float[np.ndarray, "plan frame 3"]:
        """Draw paths to the mean goal, meters, ego frame."""
        return self.paths(codes, self.scaling.goal(self._goal(codes)[0]), rng)

    def goals(self, codes: PlanCondition, rng: np.random.Generator) -> Float[np.ndarray, "plan 3"]:
        """Draw goals in the ego frame, meters."""
        return codes.on_support(self.scaling.goal(self._sample_gaussian(self._goal(codes), rng)))

    def draw_paths(
        self, codes: PlanCondition, goal: Float[np.ndarray, "plan 3"], rng: np.random.Generator
    ) -> Float[np.ndarray, "plan frame 3"]:
        """Draw a path towards each goal, meters, ego frame."""
        scaled = self._sample_gaussian(self._path(codes, goal), rng)
        return codes.constrained(self.scaling.path_of_scaled(scaled[:, :3]), self.scaling.rate_hz)

    def bodies(
        self, codes: PlanCondition, path: Float[np.ndarray, "plan frame 3"], rng: np.random.Generator
    ) -> Float[np.ndarray, "plan frame channel"]:
        """Draw bodies along paths, meters and radians, ego frame."""
        shape = len(path), len(self.scaling.body_mean), path.shape[1]
        control = self.scaling.scaled_path(path), filled((len(path), 1), 1.0)
        outputs = self._outputs(self.networks.body, shape, codes.full, *control)
        scaled = np.swapaxes(self._sample_gaussian(outputs, rng), 1, 2)
        return scaled * self.scaling.body_std + self.scaling.body_mean

    def _goal(self, codes: PlanCondition) -> list[Array]:
        return self._outputs(self.networks.goal, (len(codes.full), 3), codes.full)

    def _path(self, codes: PlanCondition, goal: Float[np.ndarray, "plan 3"]) -> list[Array]:
        shape = len(goal), PATH_CHANNELS_OF[self.scaling.encoding], self.scaling.path_std.shape[1]
        control = self.scaling.scaled_goal(goal), filled((len(goal), 1), float(codes.sampling.goal))
        return self._outputs(self.networks.path, shape, codes.full, *control)

    def _outputs(
        self, network: Callable[..., Array], shape: tuple[int, ...], *conditions: Array
    ) -> list[Array]:
        zeros = np.zeros(shape, np.float32)
        return [network(zeros, filled(len(zeros), t), *conditions) for t in (MEAN_STEP, LOG_STD_STEP)]

    def _sample_gaussian(self, outputs: list[Array], rng: np.random.Generator) -> Array:
        mean, log_std = outputs
        noise = rng.standard_normal(mean.shape, dtype=np.float32)
        return mean + np.exp(np.clip(log_std, *LOG_STD_BOUNDS)) * noise


@dataclass(frozen=True)
class OneStageSampler(Sampler):
    """Samples path and body together; the goal is the end of the path."""

    def guidance(self, sampling: PlanSamplingConfig) -> tuple[Any, ...]:
        """Return scales per channel: as in our plans, bodies are guided by at most 1."""
        both = zip(super().guidance(sampling), super().guidance(sampling.for_bodies()), strict=True)
        return tuple(np.repeat(each, self._channels)[:, None] for each in both)

    @property
    def _channels(self) -> tuple[int, int]:
        """Channels of path and body."""
        return PATH_CHANNELS_OF[self.scaling.encoding], len(self.scaling.body_mean)

    def draw_plans(
        self, codes: PlanCondition, rng: np.random.Generator, goal: Array | None, path: Array | None
    ) -> SampledPlan:
        """Draw plans, which cannot be conditioned on a goal or path."""
        assert goal is None and path is None, "a one-stage model takes no goal and no path"
        sequence = self._sequence(codes, rng)
        path = self._path(codes, sequence)
        body = np.swapaxes(sequence[:, PATH_CHANNELS_OF[self.scaling.encoding] :], 1, 2)
        body = body * self.scaling.body_std + self.scaling.body_mean
        return SampledPlan(path[:, -1], path, body)

    def plan_paths(self, codes: PlanCondition, rng: np.random.Generator) -> Float[np.ndarray, "plan frame 3"]:
        """Draw whole plans and keep the paths, meters, ego frame."""
        return self.draw_plans(codes, rng, None, None).path

    def goals(self, codes: PlanCondition, rng: np.random.Generator) -> Float[np.ndarray, "plan 3"]:
        """Draw whole plans, some at once, and keep the ends of their paths."""
        rows = np.arange(len(codes.full))
        some = (codes[rows[start : start + PLANS_AT_ONCE]] for start in range(0, len(rows), PLANS_AT_ONCE))
        paths = (self._path(each, self._sequence(each, rng)) for each in some)
        return np.concatenate([path[:, -1] for path in paths])

    def _path(self, codes: PlanCondition, sequence: Array) -> Float[np.ndarray, "plan frame 3"]:
        path = self.scaling.path(sequence[:, : PATH_CHANNELS_OF[self.scaling.encoding]], codes.start)
        return codes.constrained(path, self.scaling.rate_hz)

    def _sequence(self, codes: PlanCondition, rng: np.random.Generator) -> Array:
        frames, (lead, body) = self.scaling.path_std.shape[1], self._channels
        control = np.zeros((len(codes.full), 3, frames), np.float32)

        def correct(x: Array) -> Array:
            path = self.paths_out_of_solid(codes, x[:, :lead])
            return np.concatenate([path, x[:, lead:]], axis=1)

        shape = len(codes.full), lead + body, frames
        codes_all = codes.full, *codes.references
        denoisers = [self.denoiser(self.networks.body, code, control, 0.0) for code in codes_all]
        solver, steps = self.of_sequences(codes.sampling)
        stds = solver.path_noise_std, solver.body_noise_std
        noise_std = np.repeat(stds, (lead, body))[:, None]
        return self._denoised(denoisers, shape, solver, steps, rng, correct, noise_std)
