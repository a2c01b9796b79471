"""No path leads through a body: paths go around it, or wait. `avoidance.js` of the page does so too."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float

PERSON_M = 0.12
"""Radius of a person: of the head, or of legs."""
UNKNOWN_REACH_M = 0.28
"""From the root to the muzzle of an animal without bones ahead of its root: a cat's."""
HURRY = 1.5
"""How much longer than planned a step may be that makes up for a detour."""
MIN_STEP_M = 0.04
"""A step that is led around somebody is at least this long: 0.4 m/s at 10 Hz, a walk."""

Points = Float[np.ndarray, "plan 3"]


def clearance_of(agent_from_bone_rest: Float[np.ndarray, "bone 4 4"]) -> float:
    """Return the least distance, metres, of the root from somebody's middle: that of the foremost bone at
    rest (+z) and a person's radius.
    """
    reach_m = float(agent_from_bone_rest[:, 2, 3].max())
    return PERSON_M + (reach_m if reach_m > 0 else UNKNOWN_REACH_M)


def around_person(
    path_world: Float[np.ndarray, "plan frame 3"],
    start_world: Points,
    person_world: Points,
    clearance_m: float,
    clear: Callable[[Points], Points] = lambda points: points,
) -> Float[np.ndarray, "plan frame 3"]:
    """Lead paths, which begin a frame after ``start_world``, around a person who stands still; world frame,
    metres.

    An animal that is nearer than ``clearance_m`` already does not come nearer still. ``clear`` moves points
    to where the animal may be; where that leads to the person it waits. Heights stay.
    """
    level = [0, 2]
    person = person_world[:, level]
    reach = np.minimum(clearance_m, np.linalg.norm(start_world[:, level] - person, axis=1))
    here, before, clear_path = np.array(start_world, float), start_world, []
    for wish in np.moveaxis(path_world, 1, 0):
        step = np.maximum(MIN_STEP_M, HURRY * np.linalg.norm((wish - before)[:, level], axis=1))
        before = wish
        gap = np.linalg.norm((wish - here)[:, level], axis=1)
        share = np.where(gap > step, step / np.maximum(gap, 1e-12), 1.0)[:, None]
        following = np.where([[True, False, True]], here + share * (wish - here), wish)
        meets = _crosses(here[:, level], following[:, level], person, reach)
        if meets.any():
            following[meets] = clear(_along_circle(here, wish, step, person, reach))[meets]
            waits = meets & _crosses(here[:, level], following[:, level], person, reach)
            following[waits] = np.where([[True, False, True]], here, wish)[waits]
        here = following
        clear_path.append(following)
    return np.stack(clear_path, axis=1)


def _crosses(
    start: Float[np.ndarray, "plan 2"],
    end: Float[np.ndarray, "plan 2"],
    person: Float[np.ndarray, "plan 2"],
    reach: Float[np.ndarray, "plan"],
) -> Bool[np.ndarray, "plan"]:
    """Return whether the segment from start to end comes nearer to the person than ``reach``."""
    along, towards = end - start, person - start
    share = np.clip((along * towards).sum(1) / np.maximum((along**2).sum(1), 1e-12), 0, 1)
    return np.linalg.norm(towards - share[:, None] * along, axis=1) < reach - 1e-9


def _along_circle(
    here: Points,
    wish: Points,
    step: Float[np.ndarray, "plan"],
    person: Float[np.ndarray, "plan 2"],
    reach: Float[np.ndarray, "plan"],
) -> Points:
    """Return the points a step further on the circle around the person, on the side of the wish."""
    off, wanted = here[:, [0, 2]] - person, wish[:, [0, 2]] - person
    angle = np.arctan2(off[:, 1], off[:, 0])
    turn = np.arctan2(wanted[:, 1], wanted[:, 0]) - angle
    turn = np.arctan2(np.sin(turn), np.cos(turn))
    radius = np.maximum(reach, np.linalg.norm(off, axis=1))
    angle = angle + np.sign(turn) * np.minimum(np.abs(turn), step / np.maximum(radius, 1e-6))
    return np.stack(
        [person[:, 0] + radius * np.cos(angle), wish[:, 1], person[:, 1] + radius * np.sin(angle)], axis=-1
    )
