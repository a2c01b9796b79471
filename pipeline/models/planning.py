"""Sampling plans: what the agent perceives goes in, goal, then path, then body come out (Fig. 3).

`observe` turns a context into network inputs, `Sampler.plan` draws plans from them, `Plan.world_from_agent` puts them
into the world. Networks are met through `Networks`, which torch modules and ONNX sessions can satisfy.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import nn

from pipeline.models.behavior import (
    ROOT_CHANNELS,
    BehaviorNets,
    Sampling,
    Scaling,
    channels_from_bones,
    past_channels,
)
from pipeline.models.diffusion import Schedule, guided, sample
from pipeline.models.perception import POSITION, Ego, FeatureVolume, world_from_ego
from pipeline.models.scenes import Ground, Scenes
from pipeline.models.strides import STRIDE, led, missed
from pipeline.models.trajectories import PAST, Context
from pipeline.space import rigid

Array = np.ndarray


class Networks(Protocol):
    """The four networks on NumPy arrays of float32, batch first."""

    def perceive(self, scene_grid: Array, observer_past: Array, past: Array, keep: Array) -> Array:
        """Return the perception code."""

    def goal(self, x: Array, t: Array, condition: Array) -> Array:
        """Return the noise in x; a row of the condition is for as many rows of x, one after another, as it takes."""

    def path(self, x: Array, t: Array, condition: Array, control: Array, keep: Array) -> Array:
        """Return the noise in x."""

    def body(self, x: Array, t: Array, condition: Array, control: Array, keep: Array) -> Array:
        """Return the noise in x."""


class TorchNetworks:
    """`Networks` by torch modules on any device."""

    def __init__(self, nets: BehaviorNets, device: str = "cpu"):
        self.nets, self.device = nets.eval().to(device), device

    def _run(self, module: nn.Module, *arguments: Array) -> Array:
        with torch.inference_mode():
            return module(*(torch.from_numpy(np.ascontiguousarray(a, np.float32)).to(self.device) for a in arguments)).cpu().numpy()

    def perceive(self, *arguments: Array) -> Array:
        return self._run(self.nets.perception, *arguments)

    def goal(self, *arguments: Array) -> Array:
        return self._run(self.nets.goal, *arguments)

    def path(self, *arguments: Array) -> Array:
        return self._run(self.nets.path, *arguments)

    def body(self, *arguments: Array) -> Array:
        return self._run(self.nets.body, *arguments)


@dataclass(frozen=True)
class Observation:
    """The inputs of perception, in metres and the ego frame."""

    scene_grid: Float[np.ndarray, "batch channel 64 8 64"]
    observer_past: Float[np.ndarray, "batch frame*3"]
    past: Float[np.ndarray, "batch frame*channel"]
    ground: Ground | None = None
    """where the agents may be, for samplers that keep to it"""

    def __getitem__(self, index: slice | np.ndarray) -> "Observation":
        """Return some of the batch."""
        ground = None if self.ground is None else self.ground[index]
        return Observation(self.scene_grid[index], self.observer_past[index], self.past[index], ground)

    def __len__(self) -> int:
        return len(self.past)

    def boneless(self, mean: Float[np.ndarray, "body"]) -> "Observation":
        """Return the same with the bones of a mean body, of which goals and paths make no more than of hidden ones."""
        past = self.past.reshape(len(self), PAST, -1).copy()
        past[..., POSITION + ROOT_CHANNELS :] = mean[ROOT_CHANNELS:]
        return replace(self, past=past.reshape(len(self), -1))


@dataclass(frozen=True)
class Plan:
    """Sampled futures in the ego frame."""

    goal: Float[np.ndarray, "batch 3"]
    path: Float[np.ndarray, "batch 56 3"]
    body: Float[np.ndarray, "batch 56 channel"]

    def world_from_agent(self, world_from_ego: Float[np.ndarray, "batch 4 4"]) -> Float[np.ndarray, "batch 56 4 4"]:
        """Return the root's poses."""
        ego_from_agent = rigid.make(rigid.rotation_from_6d(self.body[..., :ROOT_CHANNELS]), self.path)
        return world_from_ego[:, None] @ ego_from_agent


def observe(context: Context, scenes: FeatureVolume | Scenes, rest: Float[np.ndarray, "bone 4 4"], ego: Ego) -> Observation:
    """Encode contexts as network inputs (Eq. 11, 12, 13)."""
    frame = world_from_ego(context.world_from_agent[:, -1], ego)
    ego_from_world = rigid.inverse(frame)
    observer = rigid.apply(ego_from_world, context.observer_world).reshape(len(frame), -1).astype(np.float32)
    past = past_channels(ego_from_world[:, None] @ context.world_from_agent, channels_from_bones(context.agent_from_bone, rest))
    scenes = scenes if isinstance(scenes, Scenes) else Scenes.of(scenes)
    return Observation(scenes.around(frame, context.video), observer, past, Ground(scenes, frame, context.video))


@dataclass(frozen=True)
class Codes:
    """Perception codes, one row per plan."""

    full: Float[np.ndarray, "plan condition"]
    """of everything that is kept"""
    blind: Float[np.ndarray, "plan condition"]
    """of the same without the observer"""
    start: Float[np.ndarray, "plan 3"]
    """where the animal is now, in the ego frame"""
    ground: Ground | None
    """where goals and paths are kept to"""
    count: int = 1
    """plans of what is perceived once, whose rows are alike and stand together"""

    def __getitem__(self, some: Int[np.ndarray, "some"]) -> "Codes":
        """Return some of the rows, each on its own."""
        ground = None if self.ground is None else self.ground[some // self.count]
        return Codes(self.full[some], self.blind[some], self.start[some], ground)

    def kept(self, path: Float[np.ndarray, "plan frame 3"]) -> Float[np.ndarray, "plan frame 3"]:
        """Keep paths in metres where the agent may be, and on what carries it."""
        return path if self.ground is None else self.ground.trodden(self.ground.cleared(path), self.start)


@dataclass(frozen=True)
class Sampler:
    """Draws plans: networks, schedule and scaling together."""

    networks: Networks
    schedule: Schedule
    scaling: Scaling

    def plan(
        self,
        observation: Observation,
        sampling: Sampling,
        rng: np.random.Generator,
        *,
        count: int = 1,
        goal: Float[np.ndarray, "plan 3"] | None = None,
        path: Float[np.ndarray, "plan 56 3"] | None = None,
    ) -> Plan:
        """Draw ``count`` plans for each row, those of a row together; a given goal or path replaces its level."""
        return self.planned(self.codes(observation, sampling, count), sampling, rng, goal, path)

    def course(
        self, observation: Observation, sampling: Sampling, rng: np.random.Generator, *, count: int = 1
    ) -> Float[np.ndarray, "plan frame 3"]:
        """Draw goals and paths as `plan` does and spare the body."""
        return self.led(self.codes(observation, sampling, count), sampling, rng)

    def planned(self, codes: Codes, sampling: Sampling, rng: np.random.Generator, goal: Array | None, path: Array | None) -> Plan:
        """Draw one plan per code, each level on its own where it is not given."""
        goal = self.goals(codes, sampling, rng) if goal is None else goal
        path = self.paths(codes, goal, sampling, rng) if path is None else path
        return Plan(goal, path, self.bodies(codes, path, sampling, rng))

    def led(self, codes: Codes, sampling: Sampling, rng: np.random.Generator) -> Float[np.ndarray, "plan frame 3"]:
        """Draw one path per code, towards a goal of its own."""
        return self.paths(codes, self.goals(codes, sampling, rng), sampling, rng)

    def codes(self, observation: Observation, sampling: Sampling, count: int = 1) -> Codes:
        """Encode what is perceived, with all that ``sampling`` keeps and without the observer, ``count`` times."""
        keep = np.tile(np.array([sampling.scene, sampling.observer, sampling.past], np.float32), (len(observation), 1))
        inputs = (observation.scene_grid, observation.observer_past, observation.past)
        full = blind = np.repeat(self.networks.perceive(*inputs, keep), count, axis=0)
        if sampling.guidance != 1:
            keep[:, 1] = 0
            blind = np.repeat(self.networks.perceive(*inputs, keep), count, axis=0)
        start = np.repeat(observation.past.reshape(len(observation), PAST, -1)[:, -1, :3], count, axis=0)
        return Codes(full, blind, start, observation.ground if sampling.clear and sampling.scene else None, count)

    def goals(self, codes: Codes, sampling: Sampling, rng: np.random.Generator) -> Float[np.ndarray, "plan 3"]:
        """Draw goals in the ego frame, metres."""

        def denoise(code: Array) -> Callable[[Array, float], Array]:
            return lambda x, t: self.networks.goal(x, _filled(len(x), t), code)

        pair = denoise(codes.full[:: codes.count]), denoise(codes.blind[:: codes.count])
        x = self._drawn(*pair, (len(codes.full), 3), sampling, sampling.goal_steps, rng, lambda x: self.goals_cleared(codes, x))
        return self.scaling.goal(x)

    def paths(
        self, codes: Codes, goal: Float[np.ndarray, "plan 3"], sampling: Sampling, rng: np.random.Generator
    ) -> Float[np.ndarray, "plan 56 3"]:
        """Draw paths to goals, and others for those that do not get there although the goal is all that guidance tells."""
        path = self.walked(codes, goal, sampling, rng)
        for _ in range(sampling.path_draws - 1 if sampling.goal and sampling.guidance >= 1 else 0):
            off = missed(path, codes.start, goal)
            again = np.flatnonzero(off > 1)
            if not len(again):
                break
            other = self.walked(codes[again], goal[again], sampling, rng)
            closer = missed(other, codes.start[again], goal[again]) < off[again]
            path[again[closer]] = other[closer]
        return path

    def walked(
        self, codes: Codes, goal: Float[np.ndarray, "plan 3"], sampling: Sampling, rng: np.random.Generator
    ) -> Float[np.ndarray, "plan 56 3"]:
        """Draw a path towards each goal; the reference of the guidance sees neither observer nor goal."""
        control = self.scaling.scaled_goal(goal)

        def denoise(code: Array, keep: float) -> Callable[[Array, float], Array]:
            return lambda x, t: self.networks.path(x, _filled(len(x), t), code, control, _filled((len(x), 1), keep))

        pair = denoise(codes.full, float(sampling.goal)), denoise(codes.blind, 0.0)
        shape = len(goal), STRIDE, self.scaling.path_std.shape[1]
        drawn = replace(sampling, method="ddim")
        path = self._drawn(*pair, shape, drawn, sampling.sequence_steps, rng, lambda x: self.paths_cleared(codes, x))
        return self.paths_finished(codes, path, goal, sampling)

    def bodies(
        self, codes: Codes, path: Float[np.ndarray, "plan 56 3"], sampling: Sampling, rng: np.random.Generator
    ) -> Float[np.ndarray, "plan 56 channel"]:
        """Draw bodies along paths, which guidance never takes away."""
        control = self.scaling.told_path(path)

        def denoise(code: Array) -> Callable[[Array, float], Array]:
            return lambda x, t: self.networks.body(x, _filled(len(x), t), code, control, _filled((len(x), 1), 1.0))

        shape = (len(path), len(self.scaling.body_mean), self.scaling.path_std.shape[1])
        pair = denoise(codes.full), denoise(codes.blind)
        body = self._drawn(*pair, shape, replace(sampling, method="ddim"), sampling.sequence_steps, rng, spread=sampling.body_spread)
        return np.swapaxes(body, 1, 2) * self.scaling.body_std + self.scaling.body_mean

    def goals_cleared(self, codes: Codes, scaled: Float[np.ndarray, "plan 3"]) -> Float[np.ndarray, "plan 3"]:
        """Move scaled goals to where the agent may rest."""
        if codes.ground is None:
            return scaled
        cleared = codes.ground.cleared(self.scaling.goal(scaled)[:, None])[:, 0]
        return self.scaling.scaled_goal(codes.ground.rested(cleared))

    def paths_cleared(self, codes: Codes, scaled: Float[np.ndarray, "plan 4 frame"]) -> Float[np.ndarray, "plan 4 frame"]:
        """Move scaled paths to where the agent may be."""
        if codes.ground is None:
            return scaled
        return self.scaling.bent(scaled, codes.start, codes.ground.cleared(self.scaling.path(scaled, codes.start)))

    def paths_finished(
        self, codes: Codes, scaled: Float[np.ndarray, "plan 4 frame"], goal: Float[np.ndarray, "plan 3"], sampling: Sampling
    ) -> Float[np.ndarray, "plan frame 3"]:
        """Return scaled paths in metres, led to their goals as far as these are told, and kept where the agent may be."""
        path = led(self.scaling.path(scaled, codes.start), codes.start, goal, float(sampling.goal) * min(sampling.guidance, 1.0))
        return codes.kept(path)

    def _drawn(
        self,
        full: Callable[[Array, float], Array],
        blind: Callable[[Array, float], Array],
        shape: tuple[int, ...],
        sampling: Sampling,
        count: int,
        rng: np.random.Generator,
        correct: Callable[[Array], Array] | None = None,
        spread: float | Array = 1.0,
    ) -> Array:
        def draw() -> Array:
            return (spread * rng.standard_normal(shape, dtype=np.float32)).astype(np.float32)

        denoise = guided(full, blind, sampling.guidance)
        x = sample(denoise, draw(), self.schedule, method=sampling.method or self.schedule.method, count=count, draw=draw, correct=correct)
        return x.astype(np.float32)


def _filled(shape: int | tuple[int, int], value: float) -> Array:
    return np.full(shape, value, np.float32)
