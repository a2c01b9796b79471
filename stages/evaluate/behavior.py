"""Predictions of the next 5.6 s on the test video: ours, location prior, standing still, constant velocity.

Each method draws 16 samples per window in several trials; scores are the best of 16 (minDE, minADE), and the
energy score for the whole distribution. Truth is the reconstructed future of the test video, as in the paper.
Goals are scored on all windows, paths and bodies on some, evenly spread.
"""

import itertools

import numpy as np
from jaxtyping import Float, Int

from pipeline.baselines.predictors import BASELINES, Corrected, Predictor
from pipeline.behavior.scenes import Scenes
from pipeline.behavior.trajectories import TEST, TRAIN, BehaviorData
from pipeline.geometry import subsampling
from pipeline.metrics.intervals import Interval, bootstrapped, episodes
from pipeline.metrics.metrics import Metrics
from pipeline.metrics.scores import GOAL_SCORES, SCORES, scored
from stages.evaluate.config import Config

OURS = "ats"
MOVING_M = 0.1
"""Displacement in 5.6 s above which an animal moves."""


def behavior_metrics(
    data: BehaviorData, ours: Predictor, config: Config, scenes: Scenes | None = None
) -> Metrics:
    """Score all methods on the test windows, with intervals, and intervals of paired differences.

    With ``scenes`` the baselines are moved out of solids and onto supports, if ours is.
    """
    metrics, test = Metrics(), data.indices(TEST)
    every = np.concatenate([test, data.indices(TRAIN)])
    metrics.put("behavior/moving_windows_share", moving_share(data, every), "no windows")
    metrics.put("behavior/test_windows", len(test))
    reason = "fewer than two sessions, or none long enough for a window: there is no test video"
    if len(test) == 0 or len(data.indices(TRAIN)) == 0:
        scores = [f"behavior/{method}/{name}" for method in (OURS, *BASELINES) for name in SCORES]
        metrics.skip(["behavior/plan_windows", "behavior/plan_trials", *scores], reason)
        return metrics
    plans = subsampling.evenly(len(test), config.plan_windows)
    metrics.put("behavior/plan_windows", len(plans))
    metrics.put("behavior/plan_trials", 1)
    episode = episodes(data.start[test], data.video[test], data.past + data.future)
    known = data.windows(data.indices(TRAIN), bones=False)
    methods: dict[str, Predictor] = {name: baseline.fit(*known) for name, baseline in BASELINES.items()}
    if scenes is not None:
        methods = {name: Corrected(each, scenes, data.rate_hz) for name, each in methods.items()}
    methods = {OURS: ours} | methods
    protocol = {"samples": config.samples, "trials": config.trials, "seed": config.seed}
    judged = {name: scored(each, data, test, test[plans], **protocol) for name, each in methods.items()}
    episode_of = {name: episode if name in GOAL_SCORES else episode[plans] for name in SCORES}

    def interval(name: str, values: Float[np.ndarray, "window"]) -> Interval:
        return bootstrapped(values, episode_of[name], np.random.default_rng(config.seed))

    for (method, found), name in itertools.product(judged.items(), SCORES):
        if name not in found:
            metrics.skip([f"behavior/{method}/{name}"], "this method predicts goals only")
            continue
        metrics.put_mean(f"behavior/{method}/{name}", interval(name, found[name]))
        if method != OURS:
            difference = interval(name, judged[OURS][name] - found[name])
            metrics.put_mean(f"behavior/{OURS}_minus_{method}/{name}", difference)
    return metrics


def moving_share(data: BehaviorData, index: Int[np.ndarray, "window"]) -> float:
    """Return the share of windows in whose future the animal moves further than 0.1 m away."""
    if len(index) == 0:
        return float("nan")
    context, future = data.windows(index, bones=False)
    away = np.linalg.norm(future.path_world - context.world_from_agent[:, -1:, :3, 3], axis=-1)
    return float((away.max(1) > MOVING_M).mean())
