"""Baselines that need no training, on the very windows that the trained methods are judged on."""

from dataclasses import replace

import numpy as np

from pipeline.baselines.predictors import BASELINES, Corrected
from pipeline.behavior.scenes import Scenes
from pipeline.behavior.trajectories import TRAIN, BehaviorData
from pipeline.metrics.scores import scored
from stages.tabulate_behavior.reading import MethodScores


def scores(
    data: BehaviorData, scenes: Scenes | None, like: MethodScores, *, trials: int, seed: int
) -> dict[str, MethodScores]:
    """Fit each baseline to the training windows and score it on the windows of ``like``, as many samples.

    End to end, with ``scenes``, it is moved out of solids and onto supports, as plans are; beside the
    networks alone it is as it is.
    """
    context, future = data.windows(data.indices(TRAIN), bones=False)
    windows, found = [_numbers(data, each) for each in (like.goal_window, like.plan_window)], {}
    for name, baseline in BASELINES.items():
        method, values = baseline.fit(context, future), {}
        corrected = method if scenes is None else Corrected(method, scenes, data.rate_hz)
        for protocol, each in (("end_to_end", corrected), ("networks", method)):
            of_each = scored(each, data, *windows, samples=like.samples, trials=trials, seed=seed)
            values |= {f"{protocol}/{score}": value[None] for score, value in of_each.items()}
        found[name] = replace(like, values=values)
    return found


def _numbers(data: BehaviorData, windows: np.ndarray) -> np.ndarray:
    """Return the numbers of windows in the data's list."""
    where = {pair: number for number, pair in enumerate(zip(data.video, data.start, strict=True))}
    return np.array([where[video, start] for video, start in windows])
