"""Baselines and scores of path forecasts, for people and animals."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from pipeline.baselines.predictors import LocationPrior, Samples
from pipeline.behavior.trajectories import Context, Future
from pipeline.geometry import rigid
from pipeline.metrics import scores

COLLISION_M = 0.2
"""Distance below which two positions collide (Kothari et al. 2021)."""
TURN_STD_RAD = np.deg2rad(25.0)
"""Angular noise of the constant-velocity model of Schoeller et al. 2020."""


@dataclass(frozen=True)
class ConstantVelocityPath:
    """Repeats the last step, rotated by a Gaussian angle per sample (Schoeller et al. 2020); a ``speed_factor`` of 0
    stands still."""

    frames: int
    turn_std_rad: float = 0.0
    speed_factor: float = 1.0

    def sample(self, context: Context, count: int, rng: np.random.Generator) -> Samples:
        """Draw ``count`` futures for each window of the context."""
        place = context.world_from_agent[..., :3, 3]
        step = (place[:, -1] - place[:, -2]) * self.speed_factor
        angle = rng.standard_normal((len(step), count)) * self.turn_std_rad
        turn = rigid.rotation_from_vector(angle[..., None] * np.array([0.0, 1.0, 0.0]))
        step = np.squeeze(turn @ step[:, None, :, None], -1)
        path = place[:, -1, None, None] + step[:, :, None] * np.arange(1, self.frames + 1)[:, None]
        return Samples(path[:, :, -1], path)


@dataclass(frozen=True)
class LocationPriorPath:
    """Goals from the location histogram of the training windows, reached at constant speed."""

    prior: LocationPrior
    frames: int

    def sample(self, context: Context, count: int, rng: np.random.Generator) -> Samples:
        """Draw ``count`` futures for each window of the context."""
        goal = self.prior.sample(context, count, rng).goal
        start = context.world_from_agent[:, -1, :3, 3][:, None, None]
        fraction = np.arange(1, self.frames + 1)[:, None] / self.frames
        return Samples(goal, start + (goal[:, :, None] - start) * fraction)


@dataclass(frozen=True)
class ForecastScores:
    """One value per window."""

    ade_m: Float[np.ndarray, "window"]
    """average displacement error of the best sample"""
    fde_m: Float[np.ndarray, "window"]
    """final displacement error of the best sample"""
    energy_m: Float[np.ndarray, "window"]
    """energy score of the end points"""
    collides: Float[np.ndarray, "window"]
    """fraction of samples that collide with the true path of another person"""

    def means(self, selected: Bool[np.ndarray, "window"]) -> dict[str, float]:
        """Return the means over selected windows."""
        return {name: float(value[selected].mean()) for name, value in vars(self).items()}


def score_forecasts(
    samples: Samples, future: Future, others: list[Float[np.ndarray, "frame other 2"]] | None = None
) -> ForecastScores:
    """Score forecasts; ``others`` are the true positions (x, z) of all others per window, NaN where absent."""
    assert samples.path is not None
    collision_rate = np.zeros(len(samples.goal))
    for window, positions in enumerate(others or ()):
        collision_rate[window] = collisions(samples.path[window], positions).mean()
    return ForecastScores(
        scores.path_minade(samples, future),
        scores.goal_minde(samples, future),
        scores.goal_energy_score(samples, future),
        collision_rate,
    )


def collisions(
    path: Float[np.ndarray, "sample frame 3"], others: Float[np.ndarray, "frame other 2"]
) -> Bool[np.ndarray, "sample"]:
    """Return which paths come closer than `COLLISION_M` to another person at the same time."""
    square = ((path[:, :, None, ::2] - others) ** 2).sum(-1)
    return (square < COLLISION_M**2).any((1, 2))
