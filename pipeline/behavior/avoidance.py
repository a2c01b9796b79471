"""Collision avoidance: paths go around other bodies, or wait. `avoidance.js` of the page does the same."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float

PERSON_M = 0.12
"""Radius of a person, at the head or the legs."""
UNKNOWN_REACH_M = 0.28
"""Distance from root to muzzle (a cat's), for animals without bones ahead of the root."""
HURRY = 1.5
"""Factor by which a step may exceed the planned one to make up for a detour."""
MIN_STEP_M = 0.04
"""Shortest step of a detour: 0.4 m/s at 10 Hz, a walk."""

Points = Float[np.ndarray, "plan 3"]


def clearance_of(agent_from_bone_rest: Float[np.ndarray, "bone 4 4"]) -> float:
    """Return the smallest distance of the root from a person, meters: foremost bone (+z) plus radius."""
    reach_m = float(agent_from_bone_rest[:, 2, 3].max())
    return PERSON_M + (reach_m if reach_m > 0 else UNKNOWN_REACH_M)


def around_person(
    path_world: Float[np.ndarray, "plan frame 3"],
    start_world: Points,
    person_world: Points,
    clearance_m: float,
    clear: Callable[[Points], Points] = lambda points: points,
) -> Float[np.ndarray, "plan frame 3"]:
    """Deform paths around a person who stands still; world frame, meters, first frame after ``start_world``.

    An animal already nearer than ``clearance_m`` comes no nearer. ``clear`` projects points to where the
    animal may be; if the result still collides, the animal waits. Heights are unchanged.
    """
    level = [0, 2]
    person = person_world[:, level]
    reach = np.minimum(clearance_m, np.linalg.norm(start_world[:, level] - person, axis=1))
    position, previous, clear_path = np.array(start_world, float), start_world, []
    for target in np.moveaxis(path_world, 1, 0):
        step = np.maximum(MIN_STEP_M, HURRY * np.linalg.norm((target - previous)[:, level], axis=1))
        previous = target
        gap = np.linalg.norm((target - position)[:, level], axis=1)
        share = np.where(gap > step, step / np.maximum(gap, 1e-12), 1.0)[:, None]
        following = np.where([[True, False, True]], position + share * (target - position), target)
        collides = _crosses(position[:, level], following[:, level], person, reach)
        if collides.any():
            following[collides] = clear(_along_circle(position, target, step, person, reach))[collides]
            waits = collides & _crosses(position[:, level], following[:, level], person, reach)
            following[waits] = np.where([[True, False, True]], position, target)[waits]
        position = following
        clear_path.append(following)
    return np.stack(clear_path, axis=1)


def _crosses(
    start: Float[np.ndarray, "plan 2"],
    end: Float[np.ndarray, "plan 2"],
    person: Float[np.ndarray, "plan 2"],
    reach: Float[np.ndarray, "plan"],
) -> Bool[np.ndarray, "plan"]:
    """Return whether the segment from start to end passes nearer to the person than ``reach``."""
    along, towards = end - start, person - start
    share = np.clip((along * towards).sum(1) / np.maximum((along**2).sum(1), 1e-12), 0, 1)
    return np.linalg.norm(towards - share[:, None] * along, axis=1) < reach - 1e-9


def _along_circle(
    position: Points,
    target: Points,
    step: Float[np.ndarray, "plan"],
    person: Float[np.ndarray, "plan 2"],
    reach: Float[np.ndarray, "plan"],
) -> Points:
    """Return the points a tangential step around the person (one on the circle would cut it)."""
    offset, to_target = position[:, [0, 2]] - person, target[:, [0, 2]] - person
    angle = np.arctan2(offset[:, 1], offset[:, 0])
    turn = np.arctan2(to_target[:, 1], to_target[:, 0]) - angle
    away = np.linalg.norm(offset, axis=1)
    furthest = np.arctan(step / np.maximum(np.maximum(reach, away), 1e-6))
    turn = np.clip(np.arctan2(np.sin(turn), np.cos(turn)), -furthest, furthest)
    radius, angle = np.maximum(reach / np.cos(turn), away), angle + turn
    x, z = person.T + radius * np.stack([np.cos(angle), np.sin(angle)])
    return np.stack([x, target[:, 1], z], axis=-1)
