"""Long-term motion through sub-goals, and any other motion, made physical; its worth before and after.

Both are judged by the same feet: those that should stand in the motion as it was given.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from pipeline.geometry import rigid
from pipeline.longterm.bodies import SkinnedBody
from pipeline.longterm.config import MotionOptimizationConfig
from pipeline.longterm.motion_optimization import optimize_motion
from pipeline.longterm.motion_synthesis import LongTerm
from pipeline.longterm.plausibility import Plausibility, PlausibilityMeter, seams
from pipeline.longterm.short_motions import RATE_HZ, STEPS, BodyMotion, resample_motion
from pipeline.longterm.subgoals import Subgoal, plan_waypoints
from pipeline.longterm.surroundings import MotionScene


@dataclass(frozen=True)
class LongTermWorld:
    """What long-term motion takes place with and in."""

    model: LongTerm
    body: SkinnedBody
    scene: MotionScene

    @property
    def judge(self) -> PlausibilityMeter:
        """Return what measures motion here."""
        return PlausibilityMeter(self.body, self.model.contacts, self.scene.distance)


@dataclass(frozen=True)
class Journey:
    """A motion at 30 fps through sub-goals."""

    moving: BodyMotion
    subgoals_world: Float[np.ndarray, "goal 3"]
    arrival_s: Float[np.ndarray, "goal"]
    before: Plausibility
    """as the networks made it"""
    after: Plausibility
    """as it is"""
    largest_seam_m: float
    """how far the fastest vertex jumps at a seam, beyond what it does in the frames beside it"""

    @property
    def timestamp_s(self) -> Float[np.ndarray, "frame"]:
        """Time of every frame."""
        return np.arange(len(self.moving)) / RATE_HZ


def travel(
    world: LongTermWorld,
    subgoals: list[Subgoal],
    settings: MotionOptimizationConfig | None,
    rng: np.random.Generator,
) -> Journey:
    """Make motion through sub-goals; ``settings`` None leaves it as the networks made it."""
    places = plan_waypoints(None, subgoals, world.scene, world.model.motion_prior)
    raw, _ = world.model.long_motion(
        places.world_from_agent, world.body, world.scene, rng, stops=places.subgoal
    )
    made = refine_motion(world, raw, settings)
    return replace(
        made,
        subgoals_world=places.world_from_agent[places.subgoal, :3, 3],
        arrival_s=places.subgoal * STEPS / RATE_HZ,
    )


def refine_motion(
    world: LongTermWorld, raw: BodyMotion, settings: MotionOptimizationConfig | None
) -> Journey:
    """Make any motion at 30 fps physical where ``settings`` are given; it has no sub-goals."""
    judge, stance = world.judge, world.judge.stance(raw, should_stand=True)
    moving = raw
    if settings is not None:
        moving = optimize_motion(raw, world.model.contact_body(world.body), world.scene.distance, settings)
    before, after = (judge.plausibility(each, stance) for each in (raw, moving))
    largest_seam_m = float(seams(world.body, moving, STEPS).max(initial=0.0))
    return Journey(moving, np.zeros((0, 3)), np.zeros(0), before, after, largest_seam_m)


def refine_at_rate(
    world: LongTermWorld,
    timestamp_s: Float[np.ndarray, "frame"],
    given: BodyMotion,
    settings: MotionOptimizationConfig,
) -> tuple[BodyMotion, Plausibility, Plausibility]:
    """Optimise motion of any rate; return it at its own times, and plausibility before and after."""
    raw = resample_motion(timestamp_s, given)
    judge, stance = world.judge, world.judge.stance(raw, should_stand=True)
    done = optimize_motion(raw, world.model.contact_body(world.body), world.scene.distance, settings)
    when = np.arange(len(done)) / RATE_HZ
    at = np.minimum(timestamp_s - timestamp_s[0], when[-1])
    bones = [rigid.interpolate(when, bone, at) for bone in np.moveaxis(done.agent_from_bone, 1, 0)]
    back = BodyMotion(rigid.interpolate(when, done.world_from_agent, at), np.stack(bones, axis=1))
    return back, judge.plausibility(raw, stance), judge.plausibility(done, stance)
