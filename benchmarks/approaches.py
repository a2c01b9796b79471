"""Persons who approach an animal, and whether it flees: one criterion for a model and for the animal itself."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from numpy.lib.stride_tricks import sliding_window_view

from pipeline.behavior.trajectories import RATE_HZ
from pipeline.environments.config import EnvironmentConfig
from pipeline.environments.rewards import REACHED_M
from pipeline.environments.spaces import person_observation
from pipeline.environments.world import CLOSE_M, FLIGHT_S, AnimalWorld
from pipeline.metrics.flight import flees

TURN_GAIN = 5.0
"""Turning speed of a person who faces the animal, in shares of the highest per radian."""
OBSERVATIONS = ("animal", "velocity")
"""Without the floor plan around the person: its 256 numbers slowed learning down several times."""
HELD_OUT_SEED = 1000
"""Seed of start states and plans in the comparison, the same for all policies."""
Policy = Callable[[dict[str, Float[np.ndarray, "person ..."]]], Float[np.ndarray, "person action"]]
Ground = Float[np.ndarray, "episode step 2"]
"""Paths on the floor, world x and z, meters."""


@dataclass(frozen=True)
class Episodes:
    """Outcome of each episode at its first termination."""

    reached: Bool[np.ndarray, "episode"]
    fled: Bool[np.ndarray, "episode"]
    seconds: Float[np.ndarray, "episode"]
    person_paths: Ground
    animal_paths: Ground
    """NaN after the episode has ended."""
    scene: Int[np.ndarray, "episode"]
    """Number of the scene."""


def facing(observation: dict[str, np.ndarray]) -> Float[np.ndarray, "person"]:
    """Return the action that turns persons towards the animal."""
    return (np.arctan2(*observation["animal"].T[:2]) * TURN_GAIN).clip(-1, 1)


def walk_to(observation: dict[str, np.ndarray], share: float = 1.0) -> Float[np.ndarray, "person 3"]:
    """Turn towards the animal and walk to it at a share of full speed."""
    left, ahead = observation["animal"].T[:2]
    speed = share * np.cos(np.arctan2(left, ahead)).clip(0, 1)
    return np.stack([speed, np.zeros_like(speed), facing(observation)], axis=-1)


def stand_still(observation: dict[str, np.ndarray]) -> Float[np.ndarray, "person 3"]:
    """Stand still."""
    return np.zeros((len(observation["animal"]), 3))


def approach_at(speed_m_s: float) -> Policy:
    """Return the policy of a person who walks straight up at this speed."""
    share = speed_m_s / EnvironmentConfig.speed_m_s
    return stand_still if speed_m_s == 0 else lambda observation: walk_to(observation, share)


def run_episodes(world: AnimalWorld, policy: Policy, episodes: int) -> Episodes:
    """Run ``episodes`` episodes from held-out moments in parallel."""
    return judged(*meet(world, policy, episodes), world.scene)


def meet(world: AnimalWorld, policy: Policy, episodes: int) -> tuple[Ground, Ground]:
    """Return the paths of persons and animals from held-out moments on; a person stands once within reach."""
    world.begin(episodes, np.random.default_rng(HELD_OUT_SEED), "test")
    person, animal = [world.persons.position.copy()], [world.animal_position[:, [0, 2]]]
    arrived = world.distance_m < REACHED_M
    for _ in range(round(world.config.episode_s * RATE_HZ)):
        world.step(policy(person_observation(world)) * ~arrived[:, None])
        arrived |= world.distance_m < REACHED_M
        person.append(world.persons.position.copy())
        animal.append(world.animal_position[:, [0, 2]])
    return np.stack(person, axis=1), np.stack(animal, axis=1)


def flights(person: Ground, animal: Ground) -> Bool[np.ndarray, "episode step"]:
    """Return when an animal begins to flee: it is close to the person and its motion gets away (`flees`).

    It is what the animal does that counts, for the model and for the animal itself, not its plan or its reason: an
    animal that walks on by itself may get away as far.
    """
    window = 1 + round(FLIGHT_S * RATE_HZ)
    held = np.concatenate([animal, np.repeat(animal[:, -1:], window - 1, axis=1)], axis=1)
    path = np.moveaxis(sliding_window_view(held, window, axis=1), -1, 2)
    close = np.linalg.norm(animal - person, axis=-1) < CLOSE_M
    return close & flees(upright(path), upright(animal), upright(person))


def upright(ground: Float[np.ndarray, "*batch 2"]) -> Float[np.ndarray, "*batch 3"]:
    """Return points of the floor, x and z, as points of the world."""
    return np.insert(ground, 1, 0.0, axis=-1)


def judged(person: Ground, animal: Ground, scene: Int[np.ndarray, "episode"]) -> Episodes:
    """Return what ends each episode first, flight or reach."""
    fleeing = flights(person, animal)
    near = np.linalg.norm(animal - person, axis=-1) < REACHED_M
    steps = np.arange(near.shape[1])
    end = np.where(fleeing | near, steps, steps[-1]).min(axis=1)
    rows = np.arange(len(end))
    fled = fleeing[rows, end]
    over = steps > end[:, None]
    person, animal = (np.where(over[..., None], np.nan, path) for path in (person, animal))
    return Episodes(near[rows, end] & ~fled, fled, end / RATE_HZ, person, animal, scene)
