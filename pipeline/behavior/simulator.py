"""The behavior model as an environment: `reset(seed)`, then `step(observer)` ten times a second.

Each step plays one frame of the current plan. The next plan is sampled from the last 8 frames and blended in.
Replanning at every step would switch goals in the middle of walks and delay the next one. `AnimalBatch`
simulates many animals in one batch, `Simulator` one.
"""

from collections import deque
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from pipeline.behavior.avoidance import around_person, clearance_of
from pipeline.behavior.config import Ego, PlanSamplingConfig, ReplanningConfig
from pipeline.behavior.model import ROOT_CHANNELS, bones_from_channels, channels_from_bones
from pipeline.behavior.perception import world_from_ego
from pipeline.behavior.planning import PlanCondition, Sampler, observe
from pipeline.behavior.scenes import Scenes
from pipeline.behavior.trajectories import (
    ABSENT_M,
    TRAIN,
    BehaviorData,
    Context,
    PoseFrames,
    Trajectory,
    as_companions,
    blended_frames,
)
from pipeline.core.arguments import checked_numbers
from pipeline.geometry import rigid


@dataclass(frozen=True)
class SimulatorState:
    """The world after a step."""

    time_s: float
    world_from_agent: Float[np.ndarray, "4 4"]
    agent_from_bone: Float[np.ndarray, "bone 4 4"]
    goal_world: Float[np.ndarray, "3"]
    """where the current plan ends"""
    blocked: float
    """share of the current plan in voxels that are not allowed, 0..1"""


GOAL_CHANGE_M = 0.3
"""Distance between commanded and planned goal from which a steered animal replans."""


class AnimalBatch:
    """Animals simulated together, each in the scene of its recording.

    Animals of the same ``life``, and companions from outside of the batch, are perceived and avoided. A plan
    is followed until it ends, a perceived being moves, or the commanded goal changes; for one that leaves the
    allowed voxels, candidates are drawn. Beside companions, which move all the time, an animal keeps its goal
    until the horizon has passed, with the path nearest to its plan. ``plans_drawn`` counts the plans.
    """

    def __init__(
        self,
        sampler: Sampler,
        scenes: Scenes,
        rest: Float[np.ndarray, "bone 4 4"],
        ego: Ego,
        *,
        sampling: PlanSamplingConfig,
        chaining: ReplanningConfig,
    ):
        self.sampler, self.scenes, self.rest = sampler, scenes, rest
        self.ego: Ego = ego
        self.sampling, self.clearance_m = sampling, clearance_of(rest)
        self.chaining = chaining if sampler.corrections else replace(chaining, candidates=1)

    def begin(
        self,
        context: Context,
        rng: np.random.Generator,
        life: Int[np.ndarray, "animal"] | None = None,
        companions: Float[np.ndarray, "animal companion past_frame 4"] | None = None,
    ) -> None:
        """Start from these windows, one animal per window.

        Animals of the same ``life`` perceive each other; without it each is alone. ``companions`` are from
        outside of the batch, as in a `Context`.
        """
        bones = channels_from_bones(context.agent_from_bone, self.rest)
        self.video = None if context.video is None else np.array(context.video)
        self.rng, self.plans_drawn, self.life, self.companions = rng, 0, life, companions
        root, observer = np.array(context.world_from_agent, float), np.array(context.observer_world, float)
        count = root.shape[1]
        frames = (slice(frame, frame + 1) for frame in range(count))
        self.past = deque((PoseFrames(root[:, each], bones[:, each]) for each in frames), count)
        self.observer = deque((observer[:, frame] for frame in range(count)), count)
        self.goal_command = np.full((len(root), 3), np.nan)
        self.plan, self.goal, self.blocked = self._draw_plans(np.arange(len(root)))
        self.played, self.planned_others = np.zeros(len(root), int), self._others_now()
        self.intent_end = np.full(len(root), self.plan_frames)

    def restart(self, some: Int[np.ndarray, "some"], context: Context) -> None:
        """Restart some of the animals, each from a window of its own, with its companions if it has any."""
        bones = channels_from_bones(context.agent_from_bone, self.rest)
        if self.companions is not None and context.companions is not None:
            self.companions = self.companions.copy()
            self.companions[some] = context.companions
        if self.video is not None and context.video is not None:
            self.video[some] = context.video
        for frame, before in enumerate(self.past):  # what `step` returned stays as it was
            self.past[frame] = PoseFrames(before.root.copy(), before.bones.copy())
            self.past[frame].root[some] = context.world_from_agent[:, frame : frame + 1]
            self.past[frame].bones[some] = bones[:, frame : frame + 1]
            self.observer[frame][some] = context.observer_world[:, frame]
        self.goal_command[some] = np.nan
        plan, self.goal[some], self.blocked[some] = self._draw_plans(some)
        self.plan.root[some], self.plan.bones[some] = plan.root, plan.bones
        self.played[some], self.planned_others[some] = 0, self._others_now()[some]
        self.intent_end[some] = self.plan_frames

    def command(self, goal_world: Float[np.ndarray, "animal 3"]) -> None:
        """Set commanded goals (meters, world); NaN lets an animal choose its own."""
        released = np.isnan(goal_world).any(1) & np.isfinite(self.goal_command).all(1)
        self.intent_end = np.where(released, 0, self.intent_end)
        self.goal_command = np.array(goal_world, float)

    def step(
        self,
        observer: Float[np.ndarray, "animal 3"],
        companions: Float[np.ndarray, "animal companion past_frame 4"] | None = None,
    ) -> PoseFrames:
        """Advance by 0.1 s with the observers at these positions (meters, world) and return the new frame.

        ``companions`` are the past tracks of those from outside, as many as in `begin`.
        """
        self.observer.append(_observer(observer, (len(self.played), 3)))
        self.companions = companions
        due = np.flatnonzero(self._must_replan())
        if len(due):
            self._replan(due)
        now = np.arange(len(self.played)), self.played
        self.past.append(PoseFrames(self.plan.root[now][:, None], self.plan.bones[now][:, None]))
        self.played += 1
        return self.past[-1]

    @property
    def past_world(self) -> Float[np.ndarray, "animal past_frame 3"]:
        """Past positions of the animals, the current ones last; meters."""
        return np.concatenate([frame.root[..., :3, 3] for frame in self.past], axis=1)

    @property
    def plan_frames(self) -> int:
        """Number of frames of a plan."""
        return self.plan.root.shape[1]

    def invalidate_plans(self) -> None:
        """Make every animal replan as soon as it may."""
        self.planned_others = np.full_like(self.planned_others, np.inf)

    def _together(self, some: Int[np.ndarray, "some"]) -> Bool[np.ndarray, "some animal"] | None:
        """Return which other animals share the life of ``some``; None if each is alone."""
        if self.life is None:
            return None
        return (self.life[some][:, None] == self.life) & (some[:, None] != np.arange(len(self.life)))

    def _companions(
        self, some: Int[np.ndarray, "some"]
    ) -> Float[np.ndarray, "some companion past_frame 4"] | None:
        """Return past positions and kinds of all others but the observer; NaN if of another life."""
        found = [] if self.companions is None else [self.companions[some]]
        if (together := self._together(some)) is not None:
            found.append(np.where(together[..., None, None], as_companions(self.past_world), np.nan))
        return np.concatenate(found, axis=1) if found else None

    def _others_now(self) -> Float[np.ndarray, "animal other 3"]:
        """Return the current positions of the others, the observer first; NaN if absent."""
        observer = self.observer[-1][:, None]
        companions = self._companions(np.arange(len(observer)))
        if companions is None:
            return observer
        return np.concatenate([observer, companions[:, :, -1, :3]], axis=1)

    def _moved_noticeably(self) -> Bool[np.ndarray, "animal other"]:
        """Return which of the others, the observer first, have moved noticeably since plans were made."""
        others = self._others_now()
        moved = np.linalg.norm(others - self.planned_others, axis=-1)
        away = np.linalg.norm(others - self.past[-1].root[:, :1, :3, 3], axis=-1)
        return moved > self.chaining.observer_motion_ratio * away

    def _must_replan(self) -> Bool[np.ndarray, "animal"]:
        """Return which animals must replan: their plan ends, another moved, or their command changed."""
        moved = self._moved_noticeably() & self.sampling.observer
        reacts = moved[:, 0] & (self.played >= self.chaining.reaction_frames)
        redirected = np.linalg.norm(np.nan_to_num(self.goal_command - self.goal), axis=-1) > GOAL_CHANGE_M
        outdated = (moved.any(1) | redirected) & (self.played >= self.chaining.commitment_frames)
        return reacts | outdated | (self.played >= self.plan_frames - self.chaining.blend_frames)

    def _replan(self, some: Int[np.ndarray, "some"]) -> None:
        """Replan for some of the animals and blend their new plans in."""
        intent = self._intent(some)
        plan, self.goal[some], self.blocked[some] = self._draw_plans(some, intent)
        left = np.isfinite(intent[..., 0]).sum(1)
        self.intent_end[some] = np.where(left, left, self.plan_frames)
        for mine, animal in enumerate(some):
            remaining = animal, slice(self.played[animal], None)
            old = PoseFrames(self.plan.root[remaining], self.plan.bones[remaining])
            new = PoseFrames(plan.root[mine], plan.bones[mine])
            new = blended_frames(old, new, self.chaining.blend_frames)
            self.plan.root[animal], self.plan.bones[animal] = new.root, new.bones
        blended = some, slice(self.chaining.blend_frames), slice(3), 3
        self.plan.root[blended] = self._where_allowed(self.plan.root[blended], some)
        self.played[some], self.planned_others[some] = 0, self._others_now()[some]

    def _intent(self, some: Int[np.ndarray, "some"]) -> Float[np.ndarray, "some frame 3"]:
        """Return where animals with companions intend to be: what is left of their plans, moved with the
        companion that the goal is beside, where they may be. NaN after the horizon, without companions,
        when commanded, and where the observer has moved, to whom animals react anew.
        """
        others, then = self._others_now()[some, 1:], self.planned_others[some, 1:]
        intent = np.full((len(some), self.plan_frames, 3), np.nan)
        if not others.size:
            return intent
        remaining = self.intent_end - self.played
        free = np.isnan(self.goal_command).any(1) & ~self._moved_noticeably()[:, 0]
        for row in np.flatnonzero((free & (remaining > self.chaining.blend_frames))[some]):
            animal, left = some[row], int(remaining[some[row]])
            away = np.nan_to_num(np.linalg.norm(then[row] - self.goal[animal], axis=-1), nan=np.inf)
            attached = away.min() < self.chaining.companion_radius_m
            moved = (others - then)[row, away.argmin()] if attached else np.zeros(3)
            frame = (self.played[animal] + np.arange(left)).clip(max=self.plan_frames - 1)
            path = self.plan.root[animal, frame, :3, 3]
            moving = path + moved * (np.arange(left) / left)[:, None]
            intent[row, :left] = self._where_allowed(moving[None], some[[row]])[0]
        return intent

    def _draw_plans(
        self, some: Int[np.ndarray, "some"], intent: Float[np.ndarray, "some frame 3"] | None = None
    ) -> tuple[PoseFrames, Float[np.ndarray, "some 3"], Float[np.ndarray, "some"]]:
        """Draw plans for some of the animals: of several candidates the least blocked, and of those the
        nearest to the ``intent``, whose end is their goal; without one, the first unless it is blocked.
        """
        root, channels = (
            np.concatenate([getattr(frame, name) for frame in self.past], axis=1)[some]
            for name in ("root", "bones")
        )
        bones, observer = bones_from_channels(channels, self.rest), np.stack(self.observer, axis=1)[some]
        video = None if self.video is None else self.video[some]
        context = Context(root, bones, observer, video, companions=self._companions(some))
        future = self.sampler.scaling.path_std.shape[1]
        observation = observe(context, self.scenes, self.rest, self.ego, future)
        frame = world_from_ego(root[:, -1], self.ego)
        self.plans_drawn += len(some)
        intent = np.full((len(some), 1, 3), np.nan) if intent is None else intent
        end = intent[np.arange(len(some)), np.isfinite(intent[..., 0]).sum(1) - 1]
        goal = np.where(np.isnan(end), self.goal_command[some], end)
        commanded = rigid.apply(rigid.inverse(frame), goal[:, None])[:, 0]
        count = self.chaining.candidates if np.isfinite(intent).any() else 1
        codes = self.sampler.codes(observation, self.sampling, count)
        goal, path, blocked = self._least_blocked(codes, frame, video, commanded, intent)
        again = np.flatnonzero(blocked)
        if len(again) and self.chaining.candidates > 1:
            where, rest = None if video is None else video[again], self.chaining.candidates - 1
            more = codes.repeated(again, rest)
            others = self._least_blocked(more, frame[again], where, commanded[again], intent[again])
            better = others[2] < blocked[again]
            for mine, other in zip((goal, path, blocked), others, strict=True):
                mine[again[better]] = other[better]
        path = self._around_others(path, frame, root[:, -1, :3, 3], some)
        plan = self.sampler.draw_plans(codes[np.arange(len(some)) * count], self.rng, goal, path)
        return (
            PoseFrames(plan.world_from_agent(frame), plan.body[..., ROOT_CHANNELS:]),
            rigid.apply(frame, plan.goal[:, None])[:, 0],
            blocked,
        )

    def _around_others(
        self,
        path: Float[np.ndarray, "some frame 3"],
        frame: Float[np.ndarray, "some 4 4"],
        start_world: Float[np.ndarray, "some 3"],
        some: Int[np.ndarray, "some"],
    ) -> Float[np.ndarray, "some frame 3"]:
        """Deform paths (ego frames) around the bodies of the others, the observer's last, if corrected."""
        if not self.sampler.corrections:
            return path

        def clear(points: Float[np.ndarray, "some 3"]) -> Float[np.ndarray, "some 3"]:
            return self._where_allowed(points[:, None], some)[:, 0]

        others, clear_world = self._others_now()[some], rigid.apply(frame, path)
        for column in reversed(range(others.shape[1])):
            being = others[:, column]
            near = np.asarray(np.isfinite(being).all(1))
            if near.any():
                far = start_world + np.array([ABSENT_M, 0.0, 0.0])
                there = np.where(near[:, None], being, far)
                clear_world = around_person(clear_world, start_world, there, self.clearance_m, clear)
        return rigid.apply(rigid.inverse(frame), self._where_allowed(clear_world, some))

    def _where_allowed(
        self, path_world: Float[np.ndarray, "some frame 3"], some: Int[np.ndarray, "some"]
    ) -> Float[np.ndarray, "some frame 3"]:
        """Move paths to where the animals may be, if plans are corrected: detours and blends cut corners."""
        if not self.sampler.avoids_solid(self.sampling):
            return path_world
        return self.scenes.out_of_solid(path_world, None if self.video is None else self.video[some])

    def _least_blocked(
        self,
        codes: PlanCondition,
        frame: Float[np.ndarray, "some 4 4"],
        video: Int[np.ndarray, "some"] | None,
        commanded: Float[np.ndarray, "some 3"],
        intent: Float[np.ndarray, "some intended 3"],
    ) -> tuple[Float[np.ndarray, "some 3"], Float[np.ndarray, "some frame 3"], Float[np.ndarray, "some"]]:
        """Return goal, path and blocked share of the best of the candidates of every animal.

        ``commanded`` goals (meters, ego frame) replace sampled ones where they are not NaN.
        """
        count, goals = codes.count, self.sampler.goals(codes, self.rng)
        given = np.repeat(commanded, count, axis=0)
        goals = np.where(np.isfinite(given), given, goals).astype(goals.dtype)
        paths = self.sampler.paths(codes, goals, self.rng)
        world = rigid.apply(np.repeat(frame, count, axis=0), paths).reshape(len(frame), count, -1, 3)
        blocked = self.scenes.inside_solid(world, video).mean(-1)
        off = np.linalg.norm(world[:, :, : intent.shape[1]] - intent[:, None], axis=-1)
        off = np.nan_to_num(off).mean(-1)
        nearest = np.where(blocked == blocked.min(1, keepdims=True), off, np.inf).argmin(1)
        best = np.arange(len(frame)) * count + nearest
        return goals[best], paths[best], blocked.min(1)


def _observer(given: Any, shape: tuple[int, ...]) -> Float[np.ndarray, "*animal 3"]:
    remedy = "give positions of eyes in the world of the build, meters"
    return checked_numbers(given, shape, name="coordinates of an observer", remedy=remedy)


class Simulator:
    """A gymnasium-style environment of one animal; the action is the observer's position in the world."""

    def __init__(
        self,
        sampler: Sampler,
        data: BehaviorData,
        scenes: Scenes,
        ego: Ego,
        *,
        sampling: PlanSamplingConfig,
        chaining: ReplanningConfig,
    ):
        self.data, self.rest = data, data.agent_from_bone_rest
        self.animals = AnimalBatch(sampler, scenes, self.rest, ego, sampling=sampling, chaining=chaining)

    def reset(self, seed: int, observer: Float[np.ndarray, "3"] | None = None) -> SimulatorState:
        """Start from a random training window, with its observer or a static one at ``observer``."""
        rng = np.random.default_rng(seed)
        return self.begin(rng.choice(self.data.indices(TRAIN), 1), rng, observer)

    def begin(
        self,
        window: Int[np.ndarray, "1"],
        rng: np.random.Generator,
        observer: Float[np.ndarray, "3"] | None = None,
        companions: Float[np.ndarray, "companion past_frame 4"] | None = None,
    ) -> SimulatorState:
        """Start from this window, with ``companions`` if there are others."""
        context, _ = self.data.windows(window)
        seen = context.observer_world
        if observer is not None:
            seen = np.tile(_observer(observer, (3,)), (1, self.data.past, 1))
        context = replace(context, observer_world=seen, observer_rotation=None)
        self.animals.begin(context, rng, companions=None if companions is None else companions[None])
        self.frame = 0
        return self._state(self.animals.past[-1])

    @property
    def recording(self) -> Trajectory:
        """The recording of the initial window."""
        assert self.animals.video is not None, "windows of recordings name them"
        return self.data.trajectories[self.data.videos[self.animals.video[0]]]

    @property
    def past_world(self) -> Float[np.ndarray, "past_frame 3"]:
        """Past positions of the animal, the current one last; meters."""
        return self.animals.past_world[0]

    def step(
        self,
        observer: Float[np.ndarray, "3"],
        companions: Float[np.ndarray, "companion past_frame 4"] | None = None,
    ) -> SimulatorState:
        """Advance by 0.1 s with the observer at this position (meters, world) and these ``companions``."""
        others = None if companions is None else companions[None]
        now = self.animals.step(_observer(observer, (3,))[None], others)
        self.frame += 1
        return self._state(now)

    def _state(self, now: PoseFrames) -> SimulatorState:
        bones = bones_from_channels(now.bones[0, 0], self.rest)
        time_s, goal = self.frame / self.data.rate_hz, self.animals.goal[0].copy()
        return SimulatorState(time_s, now.root[0, 0].copy(), bones, goal, float(self.animals.blocked[0]))
