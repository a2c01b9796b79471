"""Scripted observers for rollouts without a person."""

from collections.abc import Callable
from typing import assert_never

import numpy as np
from jaxtyping import Float

from pipeline.behavior.trajectories import RATE_HZ
from stages.simulate.config import ObserverScript

Observer = Callable[[float, Float[np.ndarray, "3"]], Float[np.ndarray, "3"]]
"""From time in seconds and the animal's position to the observer's position, world meters"""
ROUND_S, TOWARDS_S = 8.0, 4.0
"""Duration of approach and return, and of the approach alone."""
UNKNOWN_OBSERVER_M = 100.0
"""Observers at this distance are not perceived; recordings place unknown observers beyond it."""


def scripted(script: ObserverScript, *, center: Float[np.ndarray, "3"], speed_m_s: float = 1.0) -> Observer:
    """Return a scripted observer; ``center`` is its place of rest, at the height of the phone."""
    match script:
        case "away":
            return lambda time_s, animal: center + np.array([UNKNOWN_OBSERVER_M, 0.0, 0.0])
        case "still":
            return lambda time_s, animal: center
        case "approach":
            return ApproachingObserver(center, speed_m_s)
        case _:
            assert_never(script)


class ApproachingObserver:
    """Walks up to the animal for 4 s, goes back to the center for 4 s."""

    def __init__(self, center: Float[np.ndarray, "3"], speed_m_s: float):
        self.center = np.asarray(center, float)
        self.position = np.asarray(center, float)
        self.stride = speed_m_s / RATE_HZ

    def __call__(self, time_s: float, animal: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
        target = (
            np.array([animal[0], self.center[1], animal[2]]) if time_s % ROUND_S < TOWARDS_S else self.center
        )
        offset = target - self.position
        distance = float(np.linalg.norm(offset))
        keep = 0.5 if time_s % ROUND_S < TOWARDS_S else 0.0
        step = np.clip(distance - keep, 0.0, self.stride)
        self.position = self.position + offset / max(distance, 1e-6) * step
        return self.position
