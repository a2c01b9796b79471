"""Minutes of motion through many sub-goals: seams, room, furniture."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from pipeline.longterm.bodies import PosedSurface
from pipeline.longterm.config import MotionOptimizationConfig
from pipeline.longterm.contacts import motion_tensors
from pipeline.longterm.journeys import LongTermWorld, travel
from pipeline.longterm.short_motions import RATE_HZ
from pipeline.longterm.subgoals import sample_visited_subgoals


@dataclass(frozen=True)
class LongMotionLength:
    """A long motion to make."""

    seconds: float
    subgoals: int


def figures(
    world: LongTermWorld,
    been: Float[np.ndarray, "place 3"],
    length: LongMotionLength,
    settings: MotionOptimizationConfig,
    seed: int,
) -> dict[str, float | None]:
    """Travel through preferred places for minutes and measure what the bars ask for; ``been`` is where the
    root was, metres, world.

    Sub-goals are due at even times, so that the animal rests at those that it reaches early.
    """
    rng = np.random.default_rng(seed)
    drawn = sample_visited_subgoals(been, length.subgoals + 1, rng)
    timed = [
        replace(goal, time_s=length.seconds * number / length.subgoals) for number, goal in enumerate(drawn)
    ]
    made = travel(world, timed, settings, rng)
    low, high = world.scene.surface.points.min(0), world.scene.surface.points.max(0)
    surface, outside = PosedSurface(world.body, world.body.sample_vertices(200)), 0.0
    for start in range(0, len(made.moving), 300):
        points = surface(*motion_tensors(made.moving[start : start + 300])).numpy()
        beyond = np.maximum(np.maximum(low - points, points - high), 0)[..., [0, 2]]
        outside = max(outside, float(beyond.max()))
    there = made.moving.world_from_agent[np.round(made.arrival_s * RATE_HZ).astype(int), :3, 3]
    reached = np.linalg.norm((there - made.subgoals_world)[:, [0, 2]], axis=1)
    found = {
        "seconds": float(made.timestamp_s[-1]),
        "subgoals": float(len(drawn) - 1),
        "largest_seam_m": made.largest_seam_m,
        "outside_room_m": outside,
        "deepest_m": made.after.deepest_m,
        "deepest_before_m": made.before.deepest_m,
        "non_collision": made.after.non_collision,
        "contact": made.after.contact,
        "slide_m_s": made.after.slide_m_s,
        "slide_before_m_s": made.before.slide_m_s,
        "subgoal_error_m": float(reached.max()),
    }
    return {
        f"longterm_minutes/{name}": value if np.isfinite(value) else None for name, value in found.items()
    }
