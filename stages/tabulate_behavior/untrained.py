"""Baselines that need no training, on the very windows that the trained methods are judged on."""

import numpy as np

from pipeline.baselines.predictors import BASELINES, Predictor
from pipeline.behavior.trajectories import TRAIN, BehaviorData
from pipeline.metrics.scores import GOAL_SCORES, PLAN_SCORES, SCORES
from stages.tabulate_behavior.reading import MethodScores

SAMPLES = 16
"""Samples per window (K), as many as `score_behavior` draws."""
FIT_STRIDE = 4
"""Every how many training windows the baselines are fitted to; neighbors are alike."""
WINDOWS_AT_ONCE = 64
"""Bounds the memory of sampled bones."""


def scores(data: BehaviorData, like: MethodScores, *, trials: int, seed: int) -> dict[str, MethodScores]:
    """Fit each baseline to the training windows and score it on the windows of ``like``."""
    context, future = data.windows(data.indices(TRAIN)[::FIT_STRIDE])
    return {
        name: _scores(baseline.fit(context, future), data, like, trials, seed)
        for name, baseline in BASELINES.items()
    }


def _scores(
    method: Predictor, data: BehaviorData, like: MethodScores, trials: int, seed: int
) -> MethodScores:
    rng, found = np.random.default_rng(seed), {}
    for windows, names in ((like.goal_window, GOAL_SCORES), (like.plan_window, PLAN_SCORES)):
        parts = []
        for some in np.array_split(_numbers(data, windows), max(len(windows) // WINDOWS_AT_ONCE, 1)):
            context, future = data.windows(some)
            count = trials if names == GOAL_SCORES else 1
            drawn = [method.sample(context, SAMPLES, rng) for _ in range(count)]
            known = names if names == GOAL_SCORES or drawn[0].path is not None else ()
            parts.append(
                {name: np.mean([SCORES[name](each, future) for each in drawn], axis=0) for name in known}
            )
        for name in parts[0]:  # no plan is projected or snapped, so two protocols are the same
            values = np.concatenate([part[name] for part in parts])[None]
            found |= {f"{protocol}/{name}": values for protocol in ("end_to_end", "networks")}
    return MethodScores(like.goal_window, like.plan_window, found, like.past, like.future)


def _numbers(data: BehaviorData, windows: np.ndarray) -> np.ndarray:
    """Return the numbers of windows in the data's list."""
    where = {pair: number for number, pair in enumerate(zip(data.video, data.start, strict=True))}
    return np.array([where[video, start] for video, start in windows])
