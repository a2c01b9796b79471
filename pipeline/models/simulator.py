"""The behaviour model as an environment: `reset(seed)`, then `step(observer)` ten times a second.

Each step plays one frame of the current plan. Every ``replan_frames`` a new plan is sampled from the last 8 frames and
faded in over ``fade_frames``. Of several plans the first that stays in allowed voxels is taken, so that chaining does
not drift through walls.
"""

from collections import deque
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from pipeline.models.behavior import ROOT_CHANNELS, Sampling, bones_from_channels, channels_from_bones
from pipeline.models.perception import Ego, FeatureVolume, world_from_ego
from pipeline.models.planning import Sampler, observe
from pipeline.models.scenes import Scenes
from pipeline.models.trajectories import FUTURE, PAST, RATE_HZ, BehaviorData, Context
from pipeline.space import rigid


@dataclass(frozen=True)
class State:
    """The world after a step."""

    time_s: float
    world_from_agent: Float[np.ndarray, "4 4"]
    agent_from_bone: Float[np.ndarray, "bone 4 4"]
    goal_world: Float[np.ndarray, "3"]
    """where the current plan ends"""
    blocked: float
    """share of the current plan in voxels that are not allowed, 0..1"""


@dataclass(frozen=True)
class Chaining:
    """How plans follow each other."""

    replan_frames: int = 8
    """frames of a plan that are played before the next one"""
    fade_frames: int = 4
    """frames over which the next plan is faded in"""
    candidates: int = 8
    """plans drawn, of which the first allowed one is taken"""


@dataclass(frozen=True)
class Frames:
    """Consecutive poses of the animal: root, and bone channels as in `behavior.json`."""

    root: Float[np.ndarray, "frame 4 4"]
    bones: Float[np.ndarray, "frame channel"]


class Simulator:
    """A gymnasium-style environment; the action is the observer's position in the world."""

    def __init__(
        self,
        sampler: Sampler,
        data: BehaviorData,
        volume: FeatureVolume,
        allowed: Bool[np.ndarray, "x y z"],
        ego: Ego,
        *,
        sampling: Sampling,
        chaining: Chaining,
    ):
        self.sampler, self.data, self.volume, self.allowed, self.ego = sampler, data, volume, allowed, ego
        self.scenes = Scenes((volume,), (allowed,), np.zeros(1, int))
        self.sampling, self.chaining, self.rest = sampling, chaining, data.agent_from_bone_rest

    def reset(self, seed: int, observer: Float[np.ndarray, "3"] | None = None) -> State:
        """Begin at a random training window, with the observer of then or one that has stood at ``observer``."""
        self.rng = np.random.default_rng(seed)
        window = self.rng.choice(np.flatnonzero(self.data.split == 0))
        context, _ = self.data.windows(np.array([window]))
        bones = channels_from_bones(context.agent_from_bone[0], self.rest)
        self.past = deque((Frames(context.world_from_agent[0, f : f + 1], bones[f : f + 1]) for f in range(PAST)), PAST)
        seen = context.observer_world[0] if observer is None else np.tile(observer, (PAST, 1))
        self.observer = deque(seen, PAST)
        self.frame, self.played = 0, 0
        self.plan, self.goal, self.blocked = self._planned()
        return self._state()

    def step(self, observer: Float[np.ndarray, "3"]) -> State:
        """Let 0.1 s pass with the observer at this position (metres, world)."""
        self.observer.append(np.asarray(observer, float))
        if self.played >= self.chaining.replan_frames:
            rest_of_plan = Frames(self.plan.root[self.played :], self.plan.bones[self.played :])
            self.plan, self.goal, self.blocked = self._planned()
            self.plan = faded(rest_of_plan, self.plan, self.chaining.fade_frames)
            self.played = 0
        self.past.append(Frames(self.plan.root[self.played : self.played + 1], self.plan.bones[self.played : self.played + 1]))
        self.played, self.frame = self.played + 1, self.frame + 1
        return self._state()

    def _planned(self) -> tuple[Frames, Float[np.ndarray, "3"], float]:
        """Draw candidates and take the first of those that are blocked least."""
        root = np.concatenate([frame.root for frame in self.past])
        bones = bones_from_channels(np.concatenate([frame.bones for frame in self.past]), self.rest)
        observation = observe(Context(root[None], bones[None], np.array(self.observer)[None]), self.scenes, self.rest, self.ego)
        frame = world_from_ego(root[-1:], self.ego)
        codes = self.sampler.codes(observation, self.sampling, self.chaining.candidates)
        goals = self.sampler.goals(codes, self.sampling, self.rng)
        paths = self.sampler.paths(codes, goals, self.sampling, self.rng)
        blocked = blocked_share(rigid.apply(frame, paths), self.volume, self.allowed)
        best = int(np.argmin(blocked))
        given = {"goal": goals[best : best + 1], "path": paths[best : best + 1]}
        plan = self.sampler.plan(observation, self.sampling, self.rng, **given)
        chosen = Frames(plan.world_from_agent(frame)[0], plan.body[0][:, ROOT_CHANNELS:])
        return chosen, rigid.apply(frame[0], plan.goal)[0], float(blocked[best])

    def _state(self) -> State:
        now = self.past[-1]
        bones = bones_from_channels(now.bones[0], self.rest)
        return State(self.frame / RATE_HZ, now.root[0], bones, self.goal, self.blocked)


def blocked_share(
    path_world: Float[np.ndarray, "plan 56 3"], volume: FeatureVolume, allowed: Bool[np.ndarray, "x y z"]
) -> Float[np.ndarray, "plan"]:
    """Return the share of each path that lies in voxels that are not allowed; outside the volume nothing is."""
    voxel, inside = volume.voxel(path_world)
    return 1.0 - (allowed[tuple(np.moveaxis(voxel, -1, 0))].astype(bool) & inside).mean(-1)


def faded(old: Frames, new: Frames, frames: int) -> Frames:
    """Blend the beginning of a new plan with the continuation of the old one, which it leaves smoothly."""
    count = min(frames, len(old.root), FUTURE)
    if count <= 0:
        return new
    share = (np.arange(count) + 1.0) / (count + 1)
    turn = np.swapaxes(old.root[:count, :3, :3], 1, 2) @ new.root[:count, :3, :3]
    part = Rotation.from_rotvec(Rotation.from_matrix(turn).as_rotvec() * share[:, None]).as_matrix()
    position = old.root[:count, :3, 3] * (1 - share[:, None]) + new.root[:count, :3, 3] * share[:, None]
    root, bones = new.root.copy(), new.bones.copy()
    root[:count] = rigid.make(old.root[:count, :3, :3] @ part, position)
    bones[:count] = old.bones[:count] * (1 - share[:, None]) + new.bones[:count] * share[:, None]
    return Frames(root, bones)
