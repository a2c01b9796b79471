"""Predictors of goal, path and body with a common interface, ``sample(context, count, rng) -> Samples``.

`Ats` is the behavior model; `LocationPrior`, `StandStill` and `ConstantVelocity` are simple baselines with
noise fitted to the training windows.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Protocol, Self

import numpy as np
from jaxtyping import Float, Int

from pipeline.baselines.samplers import sampler_of
from pipeline.behavior import model as behavior
from pipeline.behavior.config import Ego, PlanSamplingConfig
from pipeline.behavior.model import ROOT_CHANNELS, bones_from_channels
from pipeline.behavior.perception import world_from_ego
from pipeline.behavior.planning import Observation, SampledPlan, Sampler, TorchNetworks, observe
from pipeline.behavior.scenes import SceneConstraint, Scenes
from pipeline.behavior.trajectories import Context, Future
from pipeline.geometry import rigid

WINDOWS_AT_ONCE = 32
"""bounds the memory of scene grids and bones"""


@dataclass(frozen=True)
class Samples:
    """Sampled futures in the world frame; None for what a method does not predict."""

    goal: Float[np.ndarray, "window sample 3"]
    path: Float[np.ndarray, "window sample frame 3"] | None = None
    rotation: Float[np.ndarray, "window sample frame 3 3"] | None = None
    """of ``world_from_agent``"""
    agent_from_bone: Float[np.ndarray, "window sample frame bone 4 4"] | None = None


class Predictor(Protocol):
    """A predictor of the frames up to the horizon."""

    def sample(self, context: Context, count: int, rng: np.random.Generator) -> Samples:
        """Draw ``count`` futures for each window of the context."""
        ...


@dataclass(frozen=True)
class LocationPrior:
    """Unconditional histogram of the goals in the ego frame (Ziebart et al. 2009)."""

    cell: Int[np.ndarray, "cell 3"]
    probability: Float[np.ndarray, "cell"]
    cell_m: float

    @classmethod
    def fit(cls, context: Context, future: Future, *, cell_m: float = 0.1) -> Self:
        """Fit the histogram to the goals of training windows."""
        ego_from_world = rigid.inverse(world_from_ego(context.world_from_agent[:, -1], "yaw"))
        goal = rigid.apply(ego_from_world, future.goal_world[:, None])[:, 0]
        cell, count = np.unique(np.floor(goal / cell_m).astype(np.int64), axis=0, return_counts=True)
        return cls(cell, count / count.sum(), cell_m)

    def sample(self, context: Context, count: int, rng: np.random.Generator) -> Samples:
        """Draw cells by probability, and points uniformly inside; a window's do not depend on others."""
        drawn = rng.random((len(context), count, 4))
        chosen = np.searchsorted(self.probability.cumsum()[:-1], drawn[..., 0], side="right")
        goal = (self.cell[chosen] + drawn[..., 1:]) * self.cell_m
        return Samples(rigid.apply(world_from_ego(context.world_from_agent[:, -1], "yaw"), goal))


@dataclass(frozen=True)
class StandStill:
    """The animal keeps position and posture, up to Gaussian noise that grows with time as in training."""

    std: Float[np.ndarray, "frame 3"]

    @classmethod
    def fit(cls, context: Context, future: Future) -> Self:
        """Fit the noise to the residuals of training windows, horizontal axes pooled."""
        residual = future.path_world - cls.mean(context, future.path_world.shape[1])
        level = np.sqrt((residual[..., ::2] ** 2).mean((0, 2)))
        return cls(np.stack([level, np.sqrt((residual[..., 1] ** 2).mean(0)), level], axis=-1))

    @classmethod
    def mean(cls, context: Context, frames: int) -> Float[np.ndarray, "window frame 3"]:
        """Return the path without noise."""
        return np.repeat(context.world_from_agent[:, -1:, :3, 3], frames, axis=1)

    def sample(self, context: Context, count: int, rng: np.random.Generator) -> Samples:
        """Draw one deviation per sample and let it grow with time."""
        mean = self.mean(context, len(self.std))
        path = mean[:, None] + rng.standard_normal((len(context), count, 1, 3)) * self.std
        shape = (len(context), count, mean.shape[1])
        rotation = np.broadcast_to(context.world_from_agent[:, -1, :3, :3][:, None, None], (*shape, 3, 3))
        bones = context.agent_from_bone[:, -1]
        bones = np.broadcast_to(bones[:, None, None], (*shape, *bones.shape[1:]))
        return Samples(path[:, :, -1], path, rotation, bones)


class ConstantVelocity(StandStill):
    """The animal keeps velocity and posture, up to Gaussian noise that grows with time."""

    @classmethod
    def mean(cls, context: Context, frames: int) -> Float[np.ndarray, "window frame 3"]:
        """Return the path without noise."""
        position = context.world_from_agent[..., :3, 3]
        step = (position[:, -1] - position[:, 0]) / (position.shape[1] - 1)
        return super().mean(context, frames) + step[:, None] * np.arange(1, frames + 1)[:, None]


BASELINES = {
    "location_prior": LocationPrior,
    "stand_still": StandStill,
    "constant_velocity": ConstantVelocity,
}
"""The simple baselines by the names of their metrics."""


@dataclass(frozen=True)
class Corrected:
    """Another predictor, with goals and paths out of solids and on supporting surfaces, as `Ats` has them."""

    predictor: Predictor
    scenes: Scenes
    rate_hz: float

    def sample(self, context: Context, count: int, rng: np.random.Generator) -> Samples:
        """Draw ``count`` futures for each window and correct them."""
        drawn, now = self.predictor.sample(context, count, rng), context.world_from_agent[:, -1, :3, 3]
        already_world = np.broadcast_to(np.eye(4), (len(context), 4, 4))
        limit, start = SceneConstraint(self.scenes, already_world, context.video), now.repeat(count, axis=0)
        goal, path = limit.goals_on_support(drawn.goal.reshape(-1, 3), start), drawn.path
        if path is not None:
            free = limit.out_of_solid(path.reshape(len(start), -1, 3))
            path = limit.on_support(free, start, self.rate_hz).reshape(path.shape)
        return replace(drawn, goal=goal.reshape(drawn.goal.shape), path=path)


@dataclass(frozen=True)
class Ats:
    """The behavior model: goal, path and body by diffusion from the perception code."""

    sampler: Sampler
    scenes: Scenes
    agent_from_bone_rest: Float[np.ndarray, "bone 4 4"]
    ego: Ego
    sampling: PlanSamplingConfig

    @classmethod
    def load(cls, model: Path, scenes: Scenes, sampling: PlanSamplingConfig, *, device: str = "cpu") -> "Ats":
        """Read a trained model (`behavior/`)."""
        architecture, nets, scaling, schedule, rest = behavior.load(model)
        if architecture.scene == "none":
            scenes = scenes.without_features()
        sampler = sampler_of(architecture, TorchNetworks(nets, device), schedule, scaling)
        uses_scene = architecture.ablated_input != "scene" and architecture.scene != "none"
        sampling = replace(sampling, avoid_solid=sampling.avoid_solid and uses_scene)
        return cls(sampler, scenes, rest, architecture.ego, sampling)

    def sample(self, context: Context, count: int, rng: np.random.Generator) -> Samples:
        """Draw ``count`` plans for each window."""
        plan, parts = self.sampler.plan, _chunks(context)
        plans = (plan(self.observe(part), self.sampling, rng, count=count) for part in parts)
        return joined([*map(self.in_world, plans, parts)])

    def in_world(self, plan: SampledPlan, context: Context) -> Samples:
        """Return plans of these windows, equally many of each, in the world frame."""
        count = len(plan.goal) // len(context)
        frame = np.repeat(world_from_ego(context.world_from_agent[:, -1], self.ego), count, axis=0)
        root, goal = plan.world_from_agent(frame), rigid.apply(frame, plan.goal[:, None])[:, 0]
        bones = bones_from_channels(plan.body[..., ROOT_CHANNELS:], self.agent_from_bone_rest)
        rows = goal, root[..., :3, 3], root[..., :3, :3], bones.astype(np.float32)
        return Samples(*(part.reshape(len(context), count, *part.shape[1:]) for part in rows))

    @property
    def future(self) -> int:
        """Number of predicted frames."""
        return self.sampler.scaling.path_std.shape[1]

    def goals(self, context: Context, count: int, rng: np.random.Generator) -> Samples:
        """Draw goals only, at a hundredth of the cost of plans."""
        goals = []
        for chunk in _chunks(context):
            codes = self.sampler.codes(self.observe(chunk), self.sampling, count)
            goal = self.sampler.goals(codes, rng).reshape(len(chunk), count, 3)
            goals.append(rigid.apply(world_from_ego(chunk.world_from_agent[:, -1], self.ego), goal))
        return Samples(np.concatenate(goals))

    def paths(
        self, context: Context, count: int, rng: np.random.Generator, *, at_once: int = WINDOWS_AT_ONCE
    ) -> Samples:
        """Draw goals and paths without bodies; the goals returned are the ends of the paths.

        ``at_once`` windows are encoded together: without a scene thousands fit into memory.
        """
        parts = []
        for chunk in _chunks(context, at_once):
            path = self.sampler.plan_paths(self.sampler.codes(self.observe(chunk), self.sampling, count), rng)
            frame = np.repeat(world_from_ego(chunk.world_from_agent[:, -1], self.ego), count, axis=0)
            path = rigid.apply(frame, path)
            parts.append(path.reshape(len(chunk), count, *path.shape[1:]))
        path = np.concatenate(parts)
        return Samples(path[:, :, -1], path)

    def observe(self, context: Context) -> Observation:
        """Return what the model perceives in each window."""
        return observe(context, self.scenes, self.agent_from_bone_rest, self.ego)


def joined(parts: Sequence[Samples]) -> Samples:
    """Join the samples of consecutive windows."""
    return Samples(*map(np.concatenate, zip(*(vars(part).values() for part in parts), strict=True)))


def _chunks(context: Context, at_once: int = WINDOWS_AT_ONCE) -> list[Context]:
    return [context[start : start + at_once] for start in range(0, len(context), at_once)]
