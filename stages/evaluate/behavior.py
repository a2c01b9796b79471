"""Predictions of the next 5.6 s on the test video: ours, location prior, standing still, constant velocity.

Each method draws 16 samples per window in several trials; scores are the best of 16 (minDE, minADE), and the
energy score for the whole distribution. Truth is the reconstructed future of the test video, as in the paper.
Goals are scored on all windows, paths and bodies on some, evenly spread.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float, Int

from pipeline.baselines.predictors import BASELINES, WINDOWS_AT_ONCE, Ats, LocationPrior, Predictor, Samples
from pipeline.behavior.trajectories import TEST, TRAIN, BehaviorData
from pipeline.geometry import subsampling
from pipeline.metrics.intervals import Interval, bootstrapped, episodes
from pipeline.metrics.metrics import Metrics
from pipeline.metrics.scores import GOAL_SCORES, PLAN_SCORES, SCORES
from stages.evaluate.config import Config

OURS = "ats"
MOVING_M = 0.1
"""Displacement in 5.6 s above which an animal moves."""
Scores = dict[str, Float[np.ndarray, "window"]]
"""Scores of one method by the names of `SCORES`"""


def behavior_metrics(data: BehaviorData, ours: Predictor, config: Config) -> Metrics:
    """Score all methods on the test windows, with intervals, and intervals of paired differences."""
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
    methods = {OURS: ours} | {name: baseline.fit(*known) for name, baseline in BASELINES.items()}
    judged = {name: _scores(each, data, test, test[plans], config) for name, each in methods.items()}
    episode_of = {name: episode if name in GOAL_SCORES else episode[plans] for name in SCORES}
    _report(metrics, judged, episode_of, config)
    return metrics


def moving_share(data: BehaviorData, index: Int[np.ndarray, "window"]) -> float:
    """Return the share of windows in whose future the animal moves further than 0.1 m away."""
    if len(index) == 0:
        return float("nan")
    context, future = data.windows(index, bones=False)
    away = np.linalg.norm(future.path_world - context.world_from_agent[:, -1:, :3, 3], axis=-1)
    return float((away.max(1) > MOVING_M).mean())


def _scores(
    method: Predictor,
    data: BehaviorData,
    test: Int[np.ndarray, "window"],
    chosen: Int[np.ndarray, "chosen"],
    config: Config,
) -> Scores:
    """Score goals on all test windows, mean over trials, and one trial of plans, if any, on chosen ones."""
    rng, goals, plans = np.random.default_rng(config.seed), [], []
    drawn = _goals(method, data, test, config.samples * config.trials, rng)
    for window, sampled in zip(_chunks(test), _chunks(drawn), strict=True):
        future = data.windows(window, bones=False)[1]
        trials = [Samples(trial) for trial in np.split(sampled, config.trials, axis=1)]
        goals.append(
            {name: np.mean([SCORES[name](trial, future) for trial in trials], axis=0) for name in GOAL_SCORES}
        )
    for window in _chunks(chosen):
        context, future = data.windows(window)
        samples = method.sample(context, config.samples, rng)
        if samples.path is None:
            break
        plans.append({name: SCORES[name](samples, future) for name in PLAN_SCORES})
    return _joined(goals) | _joined(plans)


def _goals(
    method: Predictor,
    data: BehaviorData,
    test: Int[np.ndarray, "window"],
    count: int,
    rng: np.random.Generator,
) -> Float[np.ndarray, "window sample 3"]:
    """Draw goals, without paths and bodies if the method can, in chunks to bound memory.

    Samples must not depend on the chunks: the location prior, which draws all cells first, has a single one.
    """
    at_once = isinstance(method, LocationPrior)
    draw = method.goals if isinstance(method, Ats) else method.sample
    parts = [test] if at_once else _chunks(test)
    # Goals may be views of paths: copies free these.
    return np.concatenate(
        [draw(data.windows(part, bones=not at_once)[0], count, rng).goal.copy() for part in parts]
    )


def _chunks(array: np.ndarray) -> list[np.ndarray]:
    return [array[begin : begin + WINDOWS_AT_ONCE] for begin in range(0, len(array), WINDOWS_AT_ONCE)]


def _joined(parts: Sequence[Scores]) -> Scores:
    """Concatenate the scores of several chunks."""
    return {name: np.concatenate([part[name] for part in parts]) for name in (parts[0] if parts else ())}


def _report(
    metrics: Metrics,
    scores: Mapping[str, Scores],
    episode: Mapping[str, Int[np.ndarray, "window"]],
    config: Config,
) -> None:
    def interval(name: str, values: Float[np.ndarray, "window"]) -> Interval:
        return bootstrapped(values, episode[name], np.random.default_rng(config.seed))

    for method, of_method in scores.items():
        for name in SCORES:
            if name in of_method:
                metrics.put_mean(f"behavior/{method}/{name}", interval(name, of_method[name]))
            else:
                metrics.skip([f"behavior/{method}/{name}"], "this method predicts goals only")
    for baseline in BASELINES:
        for name in SCORES:
            if name in scores[baseline]:
                difference = interval(name, scores[OURS][name] - scores[baseline][name])
                metrics.put_mean(f"behavior/{OURS}_minus_{baseline}/{name}", difference)
