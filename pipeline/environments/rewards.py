"""Rewards by name: pure functions of what happened in a step, one number per person."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from pipeline.environments.config import RewardName

REACHED_M = 0.7
"""Distance at which the animal counts as reached: an arm's length."""
REACHED_REWARD, FLEEING_COST = 5.0, 5.0
"""Terminal reward and cost of `approach`, meters of progress; if doubled, PPO may learn to stay away."""
FOLLOW_M = 1.2
"""Distance at which `follow` is best."""


@dataclass(frozen=True)
class StepOutcome:
    """Outcome of a step, per person."""

    distance_before_m: Float[np.ndarray, "person"]
    distance_m: Float[np.ndarray, "person"]
    """Horizontal distance to the animal before and after the step."""
    animal_speed_m_s: Float[np.ndarray, "person"]
    flees: Bool[np.ndarray, "person"]
    """The animal's plan takes it away from the person, see `pipeline.environments.world`."""

    @property
    def reached(self) -> Bool[np.ndarray, "person"]:
        """Whether the animal is within reach and stays."""
        return (self.distance_m < REACHED_M) & ~self.flees


def approach(outcome: StepOutcome) -> Float[np.ndarray, "person"]:
    """Reward progress towards the animal and reaching it, punish making it flee; both end the episode."""
    progress = outcome.distance_before_m - outcome.distance_m
    return progress + REACHED_REWARD * outcome.reached - FLEEING_COST * outcome.flees


def follow(outcome: StepOutcome) -> Float[np.ndarray, "person"]:
    """Return minus the deviation of the distance from 1.2 m, meters."""
    return -np.abs(outcome.distance_m - FOLLOW_M)


def calm(outcome: StepOutcome) -> Float[np.ndarray, "person"]:
    """Return minus the animal's speed, meters per second."""
    return -outcome.animal_speed_m_s


def none(outcome: StepOutcome) -> Float[np.ndarray, "person"]:
    """Reward nothing."""
    return np.zeros_like(outcome.distance_m)


REWARDS: dict[RewardName, Callable[[StepOutcome], Float[np.ndarray, "person"]]] = {
    "approach": approach,
    "follow": follow,
    "calm": calm,
    "none": none,
}
"""All rewards by name."""
ENDING: frozenset[RewardName] = frozenset({"approach"})
"""Rewards whose episodes end when the animal is reached or flees."""
