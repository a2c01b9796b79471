"""The criterion of flight from a person, for recorded and predicted paths alike."""

import numpy as np
from jaxtyping import Bool, Float

from pipeline.behavior.trajectories import RATE_HZ

FLED_M = 0.8
WITHIN_S = 3.0


def flees(
    path_world: Float[np.ndarray, "*batch frame 3"],
    now_world: Float[np.ndarray, "*batch 3"],
    person_world: Float[np.ndarray, "*batch 3"],
) -> Bool[np.ndarray, "*batch"]:
    """Return whether the root gets 0.8 m further from the person's current position in 3 s, horizontally."""

    def away(points: Float[np.ndarray, "*batch frame 3"]) -> Float[np.ndarray, "*batch frame"]:
        return np.linalg.norm((points - person_world[..., None, :])[..., [0, 2]], axis=-1)

    within = path_world[..., : round(WITHIN_S * RATE_HZ), :]
    return away(within).max(-1) - away(now_world[..., None, :])[..., 0] > FLED_M
