"""Long-term motion through sub-goals, and any other motion, made physical; and what it is worth before and after.

Both are judged by the same feet: those that should stand in the motion as it was given.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from pipeline.models.bodies import Body
from pipeline.models.motion_optimization import Settings, optimise
from pipeline.models.motion_synthesis import LongTerm
from pipeline.models.plausibility import Judge, Plausibility, seams
from pipeline.models.short_motions import RATE_HZ, STEPS, Moving, resampled
from pipeline.models.subgoals import Subgoal, legs
from pipeline.models.surroundings import Surroundings
from pipeline.space import rigid


@dataclass(frozen=True)
class World:
    """What long-term motion takes place with and in."""

    model: LongTerm
    body: Body
    scene: Surroundings

    @property
    def judge(self) -> Judge:
        """Return what measures motion here."""
        return Judge(self.body, self.model.contacts, self.scene.distance)


@dataclass(frozen=True)
class Journey:
    """A motion at 30 fps through sub-goals."""

    moving: Moving
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


def travel(world: World, subgoals: list[Subgoal], settings: Settings | None, rng: np.random.Generator) -> Journey:
    """Make motion through sub-goals; ``settings`` None leaves it as the networks made it."""
    places = legs(None, subgoals, world.scene, world.model.habits)
    raw, _ = world.model.long_motion(places.world_from_agent, world.body, world.scene, rng, stops=places.subgoal)
    made = stayed(world, raw, settings)
    return replace(made, subgoals_world=places.world_from_agent[places.subgoal, :3, 3], arrival_s=places.subgoal * STEPS / RATE_HZ)


def stayed(world: World, raw: Moving, settings: Settings | None) -> Journey:
    """Make any motion at 30 fps physical where ``settings`` are given; it has no sub-goals."""
    judge, stance = world.judge, world.judge.stance(raw, treading=True)
    moving = raw if settings is None else optimise(raw, world.model.physique(world.body), world.scene.distance, settings)
    before, after = (judge.plausibility(each, stance) for each in (raw, moving))
    return Journey(moving, np.zeros((0, 3)), np.zeros(0), before, after, float(seams(world.body, moving, STEPS).max(initial=0.0)))


def physical(
    world: World, timestamp_s: Float[np.ndarray, "frame"], given: Moving, settings: Settings
) -> tuple[Moving, Plausibility, Plausibility]:
    """Optimise motion of any rate at 30 fps and bring it back to its own frames; tell before and after."""
    raw = resampled(timestamp_s, given)
    judge, stance = world.judge, world.judge.stance(raw, treading=True)
    done = optimise(raw, world.model.physique(world.body), world.scene.distance, settings)
    when = np.arange(len(done)) / RATE_HZ
    at = np.minimum(timestamp_s - timestamp_s[0], when[-1])
    bones = [rigid.interpolate(when, done.agent_from_bone[:, bone], at) for bone in range(done.agent_from_bone.shape[1])]
    back = Moving(rigid.interpolate(when, done.world_from_agent, at), np.stack(bones, axis=1))
    return back, judge.plausibility(raw, stance), judge.plausibility(done, stance)
