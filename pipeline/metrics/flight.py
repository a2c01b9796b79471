"""Does the animal run from a person? One definition for what it did and for what a model says it will do."""

import numpy as np
from jaxtyping import Bool, Float

from pipeline.behavior.trajectories import RATE_HZ

FLED_M = 0.8
WITHIN_S = 3.0


def flees(
    path_world: Float[np.ndarray, "*batch frame 3"],
    now_world: Float[np.ndarray, "*batch 3"],
    person_world: Float[np.ndarray, "*batch 3"],
    rate_hz: float = RATE_HZ,
) -> Bool[np.ndarray, "*batch"]:
    """Return whether within 3 s the root gets 0.8 m further from where the person is now, over the floor."""

    def away(points: Float[np.ndarray, "*batch frame 3"]) -> Float[np.ndarray, "*batch frame"]:
        return np.linalg.norm((points - person_world[..., None, :])[..., [0, 2]], axis=-1)

    within = path_world[..., : round(WITHIN_S * rate_hz), :]
    return away(within).max(-1) - away(now_world[..., None, :])[..., 0] > FLED_M
