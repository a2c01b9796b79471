"""Evaluation of minutes of motion through many sub-goals: seams, penetration, leaving the room."""

from dataclasses import replace

import numpy as np

from pipeline.longterm.bodies import PosedSurface
from pipeline.longterm.journeys import travel
from pipeline.longterm.short_motions import RATE_HZ
from pipeline.longterm.subgoals import sample_visited_subgoals
from pipeline.metrics.intervals import finite
from stages.tabulate_longterm.config import Config
from stages.tabulate_longterm.reading import MotionSource

SAMPLED_VERTICES, FRAMES_AT_ONCE = 200, 300
"""Vertices tested for being outside the room, and frames per batch."""


def figures(source: MotionSource, config: Config) -> dict[str, float | None]:
    """Return metrics of minutes of travel through often visited places of the reconstructed scene.

    Sub-goals are due at even times, so that the animal rests where it arrives early.
    """
    world = source.world
    visited = np.concatenate(
        [stretch.world_from_agent[::3, :3, 3] for stretch in source.split.train.stretches]
    )
    rng = np.random.default_rng(config.seed)
    drawn = sample_visited_subgoals(visited, config.subgoals + 1, rng)
    timed = [
        replace(goal, time_s=config.minutes_s * number / config.subgoals) for number, goal in enumerate(drawn)
    ]
    made = travel(world, timed, config.optimization, rng)
    low, high = world.scene.surface.points.min(0), world.scene.surface.points.max(0)
    surface, outside = PosedSurface(world.body, world.body.sample_vertices(SAMPLED_VERTICES)), 0.0
    for start in range(0, len(made.motion), FRAMES_AT_ONCE):
        points = surface(*made.motion[start : start + FRAMES_AT_ONCE].tensors()).numpy()
        beyond = np.maximum(np.maximum(low - points, points - high), 0)[..., [0, 2]]
        outside = max(outside, float(beyond.max()))
    arrival = made.motion.world_from_agent[np.round(made.arrival_s * RATE_HZ).astype(int), :3, 3]
    subgoal_error = np.linalg.norm((arrival - made.subgoals_world)[:, [0, 2]], axis=1)
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
        "subgoal_error_m": float(subgoal_error.max()),
    }
    return {f"longterm_minutes/{name}": finite(value) for name, value in found.items()}
