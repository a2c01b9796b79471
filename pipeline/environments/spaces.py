"""Observation and action spaces for Gymnasium."""

from typing import Any, assert_never

import gymnasium
import numpy as np
from jaxtyping import Shaped

from pipeline.environments.floor import CELLS, to_local
from pipeline.environments.rgbd import FAR_M, HEIGHT_PX, WIDTH_PX
from pipeline.environments.world import ANIMAL_NUMBERS, AnimalWorld, occupancy_seen, others_seen, seen_from

FAR = 20.0
"""Bound of all observed numbers: meters or m/s; homes are smaller, animals slower."""


def person_observation_space(world: AnimalWorld) -> gymnasium.spaces.Dict:
    """Return the space of `person_observation`."""
    box = gymnasium.spaces.Box
    parts: dict[str, gymnasium.Space] = {}
    for seen in world.config.observations:
        match seen:
            case "animal":
                parts["animal"] = box(-FAR, FAR, (ANIMAL_NUMBERS,), np.float32)
                if others := len(world.names) - 1:
                    parts["others"] = box(-FAR, FAR, (others, 1 + ANIMAL_NUMBERS), np.float32)
            case "velocity":
                parts["velocity"] = box(-FAR, FAR, (2,), np.float32)
            case "occupancy":
                parts["occupancy"] = box(0.0, 1.0, (CELLS, CELLS), np.float32)
            case "rgbd":
                parts["rgb"] = box(0, 255, (HEIGHT_PX, WIDTH_PX, 3), np.uint8)
                parts["depth"] = box(0.0, FAR_M, (HEIGHT_PX, WIDTH_PX), np.float32)
            case _:
                assert_never(seen)
    return gymnasium.spaces.Dict(parts)


def person_observation(world: AnimalWorld) -> dict[str, Shaped[np.ndarray, "person ..."]]:
    """Return all persons' observations, first axis person: the animal, in homes of several also the others,
    their velocity and occupancy in their own frames, and pictures with depth (meters, 0: no surface).
    """
    parts: dict[str, np.ndarray] = {}
    here = world.persons.position, world.persons.heading
    for seen in world.config.observations:
        match seen:
            case "animal":
                parts["animal"] = seen_from(world, world.target, *here).clip(-FAR, FAR)
                if len(world.names) > 1:
                    parts["others"] = others_seen(world, world.target, *here).clip(-FAR, FAR)
            case "velocity":
                velocity = to_local(world.persons.velocity, world.persons.heading)
                parts["velocity"] = velocity.astype(np.float32).clip(-FAR, FAR)
            case "occupancy":
                parts["occupancy"] = occupancy_seen(world)
            case "rgbd":
                parts["rgb"], parts["depth"] = map(np.stack, zip(*world.pictures(), strict=True))
            case _:
                assert_never(seen)
    return parts


def require_reset(env: Any) -> None:
    """Raise Gymnasium's error where an environment was not reset, which counts its frames from then on."""
    if not hasattr(env, "frame"):
        raise gymnasium.error.ResetNeeded("call reset() before step() and render()")


def person_action_space(world: AnimalWorld) -> gymnasium.spaces.Box:
    """Return (forward, left, turn) of a person or (forward, turn) of a robot, relative to top speed."""
    return gymnasium.spaces.Box(-1.0, 1.0, (world.action_size,), np.float32)
