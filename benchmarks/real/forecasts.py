"""Baselines and scores of forecast paths, shared by people and animals."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from pipeline.baselines.predictors import LocationPrior, Samples
from pipeline.behavior.trajectories import Context, Future
from pipeline.geometry import rigid
from pipeline.metrics import scores

COLLISION_M = 0.2
"""Centres nearer than this collide (Kothari et al. 2021)."""
TURN_STD_RAD = np.deg2rad(25.0)
"""Of the noisy constant velocity of Schoeller et al. 2020."""


@dataclass(frozen=True)
class StraightOn:
    """The last step is repeated, each sample's turned by a Gaussian angle (Schoeller et al. 2020); or, with a
    ``share`` of 0, nobody moves."""

    frames: int
    turn_std_rad: float = 0.0
    share: float = 1.0

    def sample(self, context: Context, count: int, rng: np.random.Generator) -> Samples:
        """Draw ``count`` futures for each window of the context."""
        place = context.world_from_agent[..., :3, 3]
        step = (place[:, -1] - place[:, -2]) * self.share
        angle = rng.standard_normal((len(step), count)) * self.turn_std_rad
        turn = rigid.rotation_from_vector(angle[..., None] * np.array([0.0, 1.0, 0.0]))
        step = np.squeeze(turn @ step[:, None, :, None], -1)
        path = place[:, -1, None, None] + step[:, :, None] * np.arange(1, self.frames + 1)[:, None]
        return Samples(path[:, :, -1], path)


@dataclass(frozen=True)
class StraightToPrior:
    """Goals of the training windows' histogram, reached at an even speed."""

    prior: LocationPrior
    frames: int

    def sample(self, context: Context, count: int, rng: np.random.Generator) -> Samples:
        """Draw ``count`` futures for each window of the context."""
        goal = self.prior.sample(context, count, rng).goal
        start = context.world_from_agent[:, -1, :3, 3][:, None, None]
        share = np.arange(1, self.frames + 1)[:, None] / self.frames
        return Samples(goal, start + (goal[:, :, None] - start) * share)


@dataclass(frozen=True)
class ForecastScores:
    """One number per window."""

    ade_m: Float[np.ndarray, "window"]
    """mean distance along the best path"""
    fde_m: Float[np.ndarray, "window"]
    """distance of the best end"""
    energy_m: Float[np.ndarray, "window"]
    """energy score of the ends"""
    collides: Float[np.ndarray, "window"]
    """share of the samples that come too near to somebody else's true path"""

    def means(self, some: Bool[np.ndarray, "window"]) -> dict[str, float]:
        """Return the means over some of the windows."""
        return {name: float(value[some].mean()) for name, value in vars(self).items()}


def judge(
    samples: Samples, future: Future, others: list[Float[np.ndarray, "frame other 2"]] | None = None
) -> ForecastScores:
    """Score forecasts; ``others`` are the true places of everybody else, per window (x, z), NaN where
    absent.
    """
    assert samples.path is not None
    hit = np.zeros(len(samples.goal))
    for number, there in enumerate(others or ()):
        hit[number] = collisions(samples.path[number], there).mean()
    return ForecastScores(
        scores.path_minade(samples, future),
        scores.goal_minde(samples, future),
        scores.goal_energy_score(samples, future),
        hit,
    )


def collisions(
    path: Float[np.ndarray, "sample frame 3"], others: Float[np.ndarray, "frame other 2"]
) -> Bool[np.ndarray, "sample"]:
    """Return which paths come nearer than `COLLISION_M` to somebody."""
    square = ((path[:, :, None, ::2] - others) ** 2).sum(-1)
    return (square < COLLISION_M**2).any((1, 2))
