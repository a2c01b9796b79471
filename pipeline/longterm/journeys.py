"""Long-term motion through sub-goals, or any other motion, optimized to be physically plausible.

Plausibility before and after uses the same stance: the feet that should stand in the given motion.
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
    """The model, body and scene of long-term motion."""

    model: LongTerm
    body: SkinnedBody
    scene: MotionScene

    @property
    def meter(self) -> PlausibilityMeter:
        """The meter for motion of this body in this scene."""
        return PlausibilityMeter(self.body, self.model.contacts, self.scene.distance)


@dataclass(frozen=True)
class Journey:
    """A motion at 30 fps through sub-goals."""

    motion: BodyMotion
    subgoals_world: Float[np.ndarray, "goal 3"]
    arrival_s: Float[np.ndarray, "goal"]
    before: Plausibility
    """of the networks' output"""
    after: Plausibility
    """of ``motion``"""
    largest_seam_m: float
    """largest jump of any vertex at a seam, beyond its step in the adjacent frames"""

    @property
    def timestamp_s(self) -> Float[np.ndarray, "frame"]:
        """Time of every frame."""
        return np.arange(len(self.motion)) / RATE_HZ


def travel(
    world: LongTermWorld,
    subgoals: list[Subgoal],
    settings: MotionOptimizationConfig | None,
    rng: np.random.Generator,
) -> Journey:
    """Synthesize motion through sub-goals; with ``settings`` None it is not optimized."""
    waypoints = plan_waypoints(subgoals, world.scene, world.model.motion_prior)
    roots, stops = waypoints.world_from_agent, waypoints.subgoal
    raw, _ = world.model.long_motion(roots, world.body, world.scene, rng, stops=stops)
    journey = refine_motion(world, raw, settings)
    return replace(journey, subgoals_world=roots[stops, :3, 3], arrival_s=stops * STEPS / RATE_HZ)


def refine_motion(
    world: LongTermWorld, raw: BodyMotion, settings: MotionOptimizationConfig | None
) -> Journey:
    """Optimize any motion at 30 fps, unless ``settings`` is None; the journey has no sub-goals."""
    meter, stance = world.meter, world.meter.stance(raw, should_stand=True)
    motion = raw if settings is None else optimize_motion(raw, meter, world.model.poses, settings)
    before, after = (meter.plausibility(each, stance) for each in (raw, motion))
    largest_seam_m = float(seams(world.body, motion, STEPS).max(initial=0.0))
    return Journey(motion, np.zeros((0, 3)), np.zeros(0), before, after, largest_seam_m)


def refine_at_rate(
    world: LongTermWorld,
    timestamp_s: Float[np.ndarray, "frame"],
    given: BodyMotion,
    settings: MotionOptimizationConfig,
) -> tuple[BodyMotion, Plausibility, Plausibility]:
    """Optimize motion of any rate; return it at its own times, and plausibility before and after."""
    made = refine_motion(world, resample_motion(timestamp_s, given), settings)
    query_s = np.minimum(timestamp_s - timestamp_s[0], made.timestamp_s[-1])
    body = made.motion.world_from_agent, made.motion.agent_from_bone
    motion = BodyMotion(*rigid.interpolate_body(made.timestamp_s, *body, query_s))
    return motion, made.before, made.after
