"""What is observed and what can be done, as Gymnasium spaces."""

import gymnasium
import numpy as np
from jaxtyping import Float

from pipeline.environments.floor import CELLS, to_local
from pipeline.environments.world import ANIMAL_NUMBERS, AnimalWorld, animal_seen, occupancy_seen

FAR = 20.0
"""Bound of all observed numbers: metres or m/s; homes are smaller, animals slower."""


def person_observation_space() -> gymnasium.spaces.Dict:
    """Return the space of `person_observation`."""
    return gymnasium.spaces.Dict(
        {
            "animal": gymnasium.spaces.Box(-FAR, FAR, (ANIMAL_NUMBERS,), np.float32),
            "velocity": gymnasium.spaces.Box(-FAR, FAR, (2,), np.float32),
            "occupancy": gymnasium.spaces.Box(0.0, 1.0, (CELLS, CELLS), np.float32),
        }
    )


def person_observation(world: AnimalWorld) -> dict[str, Float[np.ndarray, "person ..."]]:
    """Return what all persons observe: the animal and their own velocity in their frames, and what blocks the
    way.
    """
    velocity = to_local(world.persons.velocity, world.persons.heading)
    return {
        "animal": animal_seen(world).clip(-FAR, FAR),
        "velocity": velocity.astype(np.float32).clip(-FAR, FAR),
        "occupancy": occupancy_seen(world),
    }


def person_action_space(world: AnimalWorld) -> gymnasium.spaces.Box:
    """Return ahead, left and turn of a person, or ahead and turn of a robot, in parts of the
    highest speed.
    """
    return gymnasium.spaces.Box(-1.0, 1.0, (world.action_size,), np.float32)
