"""Hierarchical sampling of plans from an observation: goal, then path, then body (Fig. 3).

`observe` encodes a context as network inputs, `Sampler.plan` samples plans, `SampledPlan.world_from_agent`
transforms them to the world.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import nn

from pipeline.behavior import model
from pipeline.behavior.config import Ego, Guided, PlanSamplingConfig
from pipeline.behavior.diffusion import Schedule, guided, sample
from pipeline.behavior.encoders import with_anticipated
from pipeline.behavior.path_encoding import PATH_CHANNELS_OF, goal_error, snapped_to_goal
from pipeline.behavior.perception import POSITION, FeatureVolume, world_from_ego
from pipeline.behavior.scenes import SceneConstraint, Scenes
from pipeline.behavior.trajectories import ABSENT_M, Context, anticipated, anticipated_frames, nearest
from pipeline.geometry import rigid

Array = np.ndarray
Denoise = Callable[[Array, float], Array]
"""maps noisy samples and a step to the predicted noise"""


class TorchNetworks:
    """The four networks, on any device, on NumPy arrays of float32, batch first."""

    def __init__(self, nets: model.BehaviorNets, device: str = "cpu"):
        self.nets, self.device = nets.eval().to(device), device

    def _run(self, module: nn.Module, *arguments: Array) -> Array:
        tensors = [torch.from_numpy(np.ascontiguousarray(a, np.float32)).to(self.device) for a in arguments]
        with torch.inference_mode():
            return module(*tensors).cpu().numpy()

    def perceive(self, scene_grid: Array, others: Array, past: Array, keep: Array) -> Array:
        """Return the perception code."""
        return self._run(self.nets.perception, scene_grid, others, past, keep)

    def goal(self, x: Array, t: Array, condition: Array) -> Array:
        """Return the noise in x; each row of the condition is repeated to match the rows of x."""
        return self._run(self.nets.goal, x, t, condition)

    def path(self, x: Array, t: Array, condition: Array, control: Array, keep: Array) -> Array:
        """Return the noise in x."""
        return self._run(self.nets.path, x, t, condition, control, keep)

    def body(self, x: Array, t: Array, condition: Array, control: Array, keep: Array) -> Array:
        """Return the noise in x."""
        return self._run(self.nets.body, x, t, condition, control, keep)


@dataclass(frozen=True)
class Observation:
    """The inputs of perception, in meters and the ego frame."""

    scene_grid: Float[np.ndarray, "batch channel 64 8 64"]
    others: Float[np.ndarray, "batch other frame 10"]
    """poses and kinds; the observer first; past frames, then anticipated ones, if any"""
    past: Float[np.ndarray, "batch past"]
    constraint: SceneConstraint | None = None
    """where the agents may be, for samplers with constraints"""
    companion: Int[np.ndarray, "batch companion"] | None = None
    """which companion of the context each of the others behind the observer is"""

    def __getitem__(self, index: slice | np.ndarray) -> "Observation":
        """Return some of the batch."""
        constraint = None if self.constraint is None else self.constraint[index]
        companion = None if self.companion is None else self.companion[index]
        return Observation(
            self.scene_grid[index], self.others[index], self.past[index], constraint, companion
        )

    def __len__(self) -> int:
        return len(self.past)

    def without_observer(self) -> "Observation":
        """Return a copy without the observer, who is the first of the others."""
        others = self.others.copy()
        others[:, 0, :, 0] = ABSENT_M
        return replace(self, others=others)

    def without_companion(self, number: int) -> "Observation":
        """Return a copy without one of the context's companions."""
        others = self.others.copy()
        if self.companion is not None:
            others[:, 1:][self.companion == number, :, 0] = ABSENT_M
        return replace(self, others=others)


@dataclass(frozen=True)
class SampledPlan:
    """Sampled futures in the ego frame."""

    goal: Float[np.ndarray, "batch 3"]
    path: Float[np.ndarray, "batch frame 3"]
    body: Float[np.ndarray, "batch frame channel"]

    def world_from_agent(
        self, world_from_ego: Float[np.ndarray, "batch 4 4"]
    ) -> Float[np.ndarray, "batch frame 4 4"]:
        """Return the root's poses in the world."""
        ego_from_agent = rigid.make(rigid.rotation_from_6d(self.body[..., : model.ROOT_CHANNELS]), self.path)
        return world_from_ego[:, None] @ ego_from_agent


def observe(
    context: Context,
    scenes: FeatureVolume | Scenes,
    rest: Float[np.ndarray, "bone 4 4"],
    ego: Ego,
    future: int = 0,
) -> Observation:
    """Encode contexts as network inputs (Eq. 11, 12, 13).

    In plans of ``future`` frames the observer is anticipated to go on as now; 0: what it will do is unknown.
    """
    frame = world_from_ego(context.world_from_agent[:, -1], ego)
    ego_from_world = rigid.inverse(frame)
    companions, companion, agent = context.companions, None, context.world_from_agent[:, -1, :3, 3]
    if companions is not None:
        companions, companion = nearest(companions, agent)
        companions[..., :3] = rigid.apply(ego_from_world[:, None], companions[..., :3])
    others = model.other_channels(ego_from_world[:, None] @ context.world_from_observer, companions)
    if future:
        ahead = anticipated(context.observer_world, agent, anticipated_frames(future))
        ahead = rigid.apply(ego_from_world, ahead).astype(np.float32)
        others = with_anticipated(torch.from_numpy(others), torch.from_numpy(ahead)).numpy()
    bones = model.channels_from_bones(context.agent_from_bone, rest)
    past = model.past_channels(ego_from_world[:, None] @ context.world_from_agent, bones)
    scenes = scenes if isinstance(scenes, Scenes) else Scenes.of(scenes)
    constraint = SceneConstraint(scenes, frame, context.video)
    return Observation(scenes.around(frame, context.video), others, past, constraint, companion)


@dataclass(frozen=True)
class PlanCondition:
    """Conditions of plans, and the references of classifier-free guidance; one row per plan."""

    full: Float[np.ndarray, "plan condition"]
    """condition with everything that is kept"""
    references: tuple[Float[np.ndarray, "plan condition"], ...]
    """conditions without the observer, then without companions, if these are guided; or unconditional"""
    start: Float[np.ndarray, "plan 3"]
    """current position, ego frame"""
    sampling: PlanSamplingConfig
    """how plans are sampled with them"""
    constraint: SceneConstraint | None
    """constraint of goals and paths"""
    count: int = 1
    """plans per observation; their rows are equal and consecutive"""

    def __getitem__(self, some: Int[np.ndarray, "some"]) -> "PlanCondition":
        """Return some of the rows, one plan each."""
        constraint = None if self.constraint is None else self.constraint[some // self.count]
        references = tuple(code[some] for code in self.references)
        return PlanCondition(self.full[some], references, self.start[some], self.sampling, constraint)

    def repeated(self, some: Int[np.ndarray, "some"], count: int) -> "PlanCondition":
        """Return the conditions of some of the observations, for ``count`` plans each."""
        rows, limit = self[np.repeat(some * self.count, count)], self.constraint
        return replace(rows, constraint=None if limit is None else limit[some], count=count)

    def on_support(self, goal: Float[np.ndarray, "plan 3"]) -> Float[np.ndarray, "plan 3"]:
        """Move goals in meters to where the agent may rest."""
        return goal if self.constraint is None else self.constraint.goals_on_support(goal, self.start)

    def constrained(
        self, path: Float[np.ndarray, "plan frame 3"], rate_hz: float
    ) -> Float[np.ndarray, "plan frame 3"]:
        """Keep paths in meters out of solid space and on the supporting surface."""
        limit = self.constraint
        return path if limit is None else limit.on_support(limit.out_of_solid(path), self.start, rate_hz)


@dataclass(frozen=True)
class Sampler:
    """Samples plans with networks, schedule and scaling."""

    networks: TorchNetworks
    schedule: Schedule
    scaling: model.Scaling
    guided: Guided = "observer"
    """conditions that guidance amplifies"""
    corrections: bool = True
    """whether plans are corrected after the networks; else only the networks are sampled"""

    def avoids_solid(self, sampling: PlanSamplingConfig) -> bool:
        """Return whether goals and paths are kept out of solids, and on supports."""
        return self.corrections and sampling.avoid_solid and sampling.scene

    def guidance(self, sampling: PlanSamplingConfig) -> tuple[Any, ...]:
        """Return the scales of `guided`, for all channels or each: of the observer, and of all companions or
        of each, that is without the observer e + sum over companions of (scale - 1) (e - e without that one).
        """
        scales = sampling.companions_guidance
        if not isinstance(scales, tuple):
            return sampling.guidance, scales
        return (sampling.guidance, *(1 + sum(scales[k:]) - len(scales[k:]) for k in range(len(scales))))

    def plan(
        self,
        observation: Observation,
        sampling: PlanSamplingConfig,
        rng: np.random.Generator,
        *,
        count: int = 1,
        goal: Float[np.ndarray, "plan 3"] | None = None,
        path: Float[np.ndarray, "plan frame 3"] | None = None,
    ) -> SampledPlan:
        """Draw ``count`` plans per observation in one batch; a given goal or path is not sampled."""
        return self.draw_plans(self.codes(observation, sampling, count), rng, goal, path)

    def draw_plans(
        self, codes: PlanCondition, rng: np.random.Generator, goal: Array | None, path: Array | None
    ) -> SampledPlan:
        """Draw one plan per row, sampling the levels that are not given."""
        goal = self.goals(codes, rng) if goal is None else goal
        path = self.paths(codes, goal, rng) if path is None else path
        return SampledPlan(goal, path, self.bodies(codes, path, rng))

    def plan_paths(self, codes: PlanCondition, rng: np.random.Generator) -> Float[np.ndarray, "plan frame 3"]:
        """Draw one path per row, to a goal of its own, without bodies; meters, ego frame."""
        return self.paths(codes, self.goals(codes, rng), rng)

    def codes(self, observation: Observation, sampling: PlanSamplingConfig, count: int = 1) -> PlanCondition:
        """Encode the kept conditions and the references of guidance, repeating rows ``count`` times."""
        sampling = sampling if self.corrections else sampling.networks_only()
        conditions = [[sampling.scene, sampling.observer, sampling.past]]
        keep = np.repeat(np.array(conditions, np.float32), len(observation), axis=0)

        def code(seen: Observation) -> Array:
            return self.networks.perceive(seen.scene_grid, seen.others, seen.past, keep).repeat(count, axis=0)

        full, references, by_observer = code(observation), [], self.guided == "observer"
        scales = sampling.companions_guidance
        each = len(scales) if isinstance(scales, tuple) else 0
        apart = scales not in (1, (1,) * each)
        accompanied = by_observer and observation.others.shape[1] > 1 and apart
        if by_observer and (sampling.guidance != 1 or accompanied):
            references.append(code(left := observation.without_observer()))
            references += [code(left.without_companion(number)) for number in range(each) if accompanied]
        keep[:, 1 if by_observer else slice(None)] = 0
        if (accompanied and not each) or (not by_observer and sampling.guidance != 1):
            references.append(code(observation))
        past = observation.past.reshape(len(observation), -1, POSITION + len(self.scaling.body_mean))
        start = np.repeat(past[:, -1, :3], count, axis=0)
        constraint = observation.constraint if self.avoids_solid(sampling) else None
        return PlanCondition(full, tuple(references), start, sampling, constraint, count)

    def goals(self, codes: PlanCondition, rng: np.random.Generator) -> Float[np.ndarray, "plan 3"]:
        """Draw goals in the ego frame, meters."""

        def denoise(code: Array) -> Denoise:
            return lambda x, t: self.networks.goal(x, filled(len(x), t), code)

        denoisers = [denoise(code[:: codes.count]) for code in (codes.full, *codes.references)]
        steps = codes.sampling.goal_steps or self.schedule.sampled_steps
        x = self._denoised(denoisers, (len(codes.full), 3), codes.sampling, steps, rng)
        return codes.on_support(self.scaling.goal(x))

    def paths(
        self, codes: PlanCondition, goal: Float[np.ndarray, "plan 3"], rng: np.random.Generator
    ) -> Float[np.ndarray, "plan frame 3"]:
        """Draw paths to goals; paths that miss their goals are drawn again."""
        path, sampling = self.draw_paths(codes, goal, rng), codes.sampling
        for _ in range(sampling.max_path_draws - 1 if sampling.goal and sampling.guidance >= 1 else 0):
            off = goal_error(path, codes.start, goal)
            again = np.flatnonzero(off > 1)
            if not len(again):
                break
            other = self.draw_paths(codes[again], goal[again], rng)
            closer = goal_error(other, codes.start[again], goal[again]) < off[again]
            path[again[closer]] = other[closer]
        return path

    def draw_paths(
        self, codes: PlanCondition, goal: Float[np.ndarray, "plan 3"], rng: np.random.Generator
    ) -> Float[np.ndarray, "plan frame 3"]:
        """Draw a path to each goal (Eq. 9) with guidance; meters, ego frame."""
        control = self.scaling.scaled_goal(goal)
        every = [(codes.full, float(codes.sampling.goal)), *((code, 0.0) for code in codes.references)]
        denoisers = [self.denoiser(self.networks.path, code, control, keep) for code, keep in every]
        correct = partial(self.paths_out_of_solid, codes)
        shape = (len(goal), PATH_CHANNELS_OF[self.scaling.encoding], self.scaling.path_std.shape[1])
        solver, steps = self.of_sequences(codes.sampling)
        path = self._denoised(denoisers, shape, solver, steps, rng, correct, solver.path_noise_std)
        return self.decode_paths(codes, path, goal)

    def bodies(
        self, codes: PlanCondition, path: Float[np.ndarray, "plan frame 3"], rng: np.random.Generator
    ) -> Float[np.ndarray, "plan frame channel"]:
        """Draw bodies along paths; if all conditions are guided, the path is one of them."""
        control = self.scaling.scaled_path(path)
        every = [(codes.full, 1.0), *((code, float(self.guided == "observer")) for code in codes.references)]
        denoisers = [self.denoiser(self.networks.body, code, control, keep) for code, keep in every]
        shape = (len(path), len(self.scaling.body_mean), self.scaling.path_std.shape[1])
        solver, steps = self.of_sequences(codes.sampling.for_bodies())
        body = self._denoised(denoisers, shape, solver, steps, rng, noise_std=solver.body_noise_std)
        return np.swapaxes(body, 1, 2) * self.scaling.body_std + self.scaling.body_mean

    def of_sequences(self, sampling: PlanSamplingConfig) -> tuple[PlanSamplingConfig, int]:
        """Return the sampler of paths and bodies and its number of steps.

        A chosen number of steps is taken by DPM-Solver++. DDPM, which adds noise at every step, begins with
        unit variance.
        """
        if sampling.sequence_steps or self.schedule.method == "dpm_solver":
            steps = sampling.sequence_steps or self.schedule.sampled_steps
            return replace(sampling, method="dpm_solver"), steps
        ancestral = replace(sampling, method=self.schedule.method, path_noise_std=1.0, body_noise_std=1.0)
        return ancestral, self.schedule.sampled_steps

    def paths_out_of_solid(
        self, codes: PlanCondition, scaled: Float[np.ndarray, "plan channel frame"]
    ) -> Float[np.ndarray, "plan channel frame"]:
        """Project scaled paths out of solid space."""
        if codes.constraint is None:
            return scaled
        path = codes.constraint.out_of_solid(self.scaling.path(scaled, codes.start))
        return self.scaling.warped_path(scaled, codes.start, path)

    def decode_paths(
        self,
        codes: PlanCondition,
        scaled: Float[np.ndarray, "plan channel frame"],
        goal: Float[np.ndarray, "plan 3"],
    ) -> Float[np.ndarray, "plan frame 3"]:
        """Convert scaled paths to meters, snap them to the goals that condition them, and constrain them."""
        path, sampling = self.scaling.path(scaled, codes.start), codes.sampling
        pull = float(sampling.goal and sampling.snap_to_goal) * min(sampling.guidance, 1.0)
        return codes.constrained(snapped_to_goal(path, codes.start, goal, pull), self.scaling.rate_hz)

    @staticmethod
    def denoiser(network: Callable[..., Array], code: Array, control: Array, keep: float) -> Denoise:
        """Return the denoiser of paths or bodies under one condition; ``keep`` 0 drops the control."""
        return lambda x, t: network(x, filled(len(x), t), code, control, filled((len(x), 1), keep))

    def _denoised(
        self,
        denoisers: list[Denoise],
        shape: tuple[int, ...],
        sampling: PlanSamplingConfig,
        count: int,
        rng: np.random.Generator,
        correct: Callable[[Array], Array] | None = None,
        noise_std: float | Array = 1.0,
    ) -> Array:
        def draw() -> Array:
            return (noise_std * rng.standard_normal(shape, dtype=np.float32)).astype(np.float32)

        denoise = guided(denoisers, self.guidance(sampling))
        method = sampling.method or self.schedule.method
        x = sample(denoise, draw(), self.schedule, method=method, count=count, draw=draw, correct=correct)
        return x.astype(np.float32)


def filled(shape: int | tuple[int, int], value: float) -> Array:
    """Return a step of every row, or masks of shape (rows, 1), with this value."""
    return np.full(shape, value, np.float32)
