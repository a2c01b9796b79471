"""Minutes of motion through many sub-goals: seams, room, furniture."""

from dataclasses import dataclass, replace

import numpy as np

from pipeline.models.bodies import PosedSurface
from pipeline.models.contacts import tensors
from pipeline.models.journeys import World, travel
from pipeline.models.motion_optimization import Settings
from pipeline.models.short_motions import RATE_HZ
from pipeline.models.subgoals import preferred


@dataclass(frozen=True)
class Length:
    """A long motion to make."""

    seconds: float
    subgoals: int


def figures(world: World, been: np.ndarray, length: Length, settings: Settings, seed: int) -> dict[str, float | None]:
    """Travel through preferred places for minutes and measure what the bars ask for.

    Sub-goals are due at even times, so that the animal rests at those that it reaches early.
    """
    rng = np.random.default_rng(seed)
    drawn = preferred(been, length.subgoals + 1, rng)
    timed = [replace(goal, time_s=length.seconds * number / length.subgoals) for number, goal in enumerate(drawn)]
    made = travel(world, timed, settings, rng)
    low, high = world.scene.surface.points.min(0), world.scene.surface.points.max(0)
    surface, outside = PosedSurface(world.body, world.body.spread(200)), 0.0
    for start in range(0, len(made.moving), 300):
        points = surface(*tensors(made.moving[start : start + 300])).numpy()
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
    return {f"longterm_minutes/{name}": value if np.isfinite(value) else None for name, value in found.items()}
