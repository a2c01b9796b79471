"""Rivals that need no training, on the very windows that the trained methods are judged on."""

import numpy as np

from pipeline.models.predictors import ConstantVelocity, LocationPrior, Samples, StandStill
from pipeline.models.scores import GOAL_SCORES, PLAN_SCORES, SCORES
from pipeline.models.trajectories import TRAIN, BehaviorData
from stages.tabulate_behavior.reading import Scores

RIVALS = {"location_prior": LocationPrior, "stand_still": StandStill, "constant_velocity": ConstantVelocity}


def scores(data: BehaviorData, like: Scores, *, samples: int, trials: int, seed: int) -> dict[str, Scores]:
    """Fit each rival to the training windows and score it on the windows of ``like``."""
    context, future = data.windows(data.indices(TRAIN)[::4])
    return {name: _scores(rival.fit(context, future), data, like, samples, trials, seed) for name, rival in RIVALS.items()}


def _scores(
    method: LocationPrior | StandStill | ConstantVelocity, data: BehaviorData, like: Scores, samples: int, trials: int, seed: int
) -> Scores:
    rng, found = np.random.default_rng(seed), {}
    for windows, names in ((like.goal_window, GOAL_SCORES), (like.plan_window, PLAN_SCORES)):
        parts = []
        for some in np.array_split(_numbers(data, windows), max(len(windows) // 64, 1)):
            context, future = data.windows(some)
            drawn = [method.sample(context, samples, rng) for _ in range(trials if names == GOAL_SCORES else 1)]
            parts.append({name: np.mean([SCORES[name](each, future) for each in drawn], axis=0) for name in names if _told(drawn[0], name)})
        found |= {f"end_to_end/{name}": np.concatenate([part[name] for part in parts])[None] for name in parts[0]}
    return Scores(like.goal_window, like.plan_window, found)


def _told(samples: Samples, name: str) -> bool:
    return name in GOAL_SCORES or samples.path is not None


def _numbers(data: BehaviorData, windows: np.ndarray) -> np.ndarray:
    """Return the numbers of windows in the data's list."""
    where = {(int(video), int(start)): number for number, (video, start) in enumerate(zip(data.video, data.start, strict=True))}
    return np.array([where[int(video), int(start)] for video, start in windows])
