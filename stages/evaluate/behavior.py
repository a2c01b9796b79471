"""Predictions of the next 5.6 s on the test video: our model, a location prior, standing still, constant velocity.

Each method draws 16 samples a window in several trials; the best of 16 counts (minADE), and the energy score rewards
the whole distribution. Truth is the reconstructed future of the test video, as in the paper. Every method is met
through `predictors.Predictor`; goals are judged on all windows, paths and bodies on a share of them.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from pipeline.models.intervals import Interval, bootstrapped, episodes
from pipeline.models.predictors import Ats, ConstantVelocity, LocationPrior, Predictor, Samples, StandStill
from pipeline.models.scores import GOAL_SCORES, PLAN_SCORES, SCORES, goal_distances, path_distances
from pipeline.models.trajectories import FUTURE, PAST, TEST, TRAIN, BehaviorData, Context
from stages.evaluate import best_of
from stages.evaluate.figures import Figures

OURS = "ats"
RIVALS = ("location_prior", "stand_still", "constant_velocity")
MOVING_M = 0.1
CURVES = "Error of the best of K sampled goals and paths on the test windows against K: ours and the simple rivals."


@dataclass(frozen=True)
class Protocol:
    """How predictions are judged."""

    samples: int
    """per window and trial"""
    trials: int
    """of goals"""
    plan_trials: int
    """of paths and bodies"""
    plan_stride: int
    """every how many windows paths and bodies are judged"""
    draws: int
    """of the bootstrap"""
    seed: int


def rivals(data: BehaviorData) -> dict[str, Predictor]:
    """Fit the simple predictors to the training windows."""
    context, future = data.windows(data.indices(TRAIN))
    methods = (LocationPrior, StandStill, ConstantVelocity)
    return {name: method.fit(context, future) for name, method in zip(RIVALS, methods, strict=True)}


def behavior_figures(data: BehaviorData, ours: Predictor, protocol: Protocol) -> Figures:
    """Judge all methods on the test windows, with intervals and paired intervals of the differences."""
    figures, test = Figures(), data.indices(TEST)
    every = np.concatenate([test, data.indices(TRAIN)])
    figures.put("behavior/moving_windows_share", moving_share(data, every), "no windows")
    figures.put("behavior/test_windows", len(test))
    reason = "fewer than two sessions, or none long enough for a window: there is no test video"
    if len(test) == 0 or len(data.indices(TRAIN)) == 0:
        figures.skip(_names(), reason)
        return figures
    episode = episodes(data.start[test], data.video[test], PAST + FUTURE)
    judged = {name: _judged(method, data, test, protocol) for name, method in ({OURS: ours} | rivals(data)).items()}
    _report(figures, {name: each.scores for name, each in judged.items()}, episode, protocol)
    figures.charts[CURVES] = best_of.drawn({name: each.distances for name, each in judged.items()})
    return figures


def moving_share(data: BehaviorData, index: Int[np.ndarray, "window"]) -> float:
    """Return the share of windows in whose future the animal gets further than 0.1 m from where it is."""
    if len(index) == 0:
        return float("nan")
    context, future = data.windows(index, bones=False)
    away = np.linalg.norm(future.path_world - context.world_from_agent[:, -1:, :3, 3], axis=-1)
    return float((away.max(1) > MOVING_M).mean())


@dataclass(frozen=True)
class _Judged:
    """One method on the test windows."""

    scores: dict[str, Float[np.ndarray, "window"]]
    """averaged over trials"""
    distances: dict[str, Float[np.ndarray, "window sample"]]
    """of every sampled goal and path, metres"""


def _judged(method: Predictor, data: BehaviorData, test: Int[np.ndarray, "window"], protocol: Protocol) -> _Judged:
    """Judge one method; plans are judged on every ``plan_stride``-th window."""
    rng = np.random.default_rng(protocol.seed)
    context, future = data.windows(test)
    goals = _goals(method, context, protocol.samples * protocol.trials, rng)
    trials = [Samples(part) for part in np.split(goals, protocol.trials, axis=1)]
    found = {name: [SCORES[name](trial, future) for trial in trials] for name in GOAL_SCORES}
    distances = {"goal": goal_distances(Samples(goals), future)}
    context, future = data.windows(test[:: protocol.plan_stride])
    for _ in range(protocol.plan_trials):
        samples = method.sample(context, protocol.samples, rng)
        for name in PLAN_SCORES if samples.path is not None else ():
            found.setdefault(name, []).append(SCORES[name](samples, future))
        if samples.path is not None:
            distances["path"] = path_distances(samples, future)
    return _Judged({name: np.mean(values, axis=0) for name, values in found.items()}, distances)


def _goals(method: Predictor, context: Context, count: int, rng: np.random.Generator) -> Float[np.ndarray, "window sample 3"]:
    """Draw goals only where a method can, which spares the networks of path and body."""
    return (method.goals if isinstance(method, Ats) else method.sample)(context, count, rng).goal


def _report(
    figures: Figures,
    scores: Mapping[str, Mapping[str, Float[np.ndarray, "window"]]],
    episode: Int[np.ndarray, "window"],
    protocol: Protocol,
) -> None:
    def interval(values: Float[np.ndarray, "window"]) -> Interval:
        chosen = episode if len(values) == len(episode) else episode[:: protocol.plan_stride]
        return bootstrapped(values, np.unique(chosen, return_inverse=True)[1], protocol.draws, np.random.default_rng(protocol.seed))

    for method, of_method in scores.items():
        for name in SCORES:
            if name in of_method:
                figures.put_mean(f"behavior/{method}/{name}", interval(of_method[name]))
            else:
                figures.skip([f"behavior/{method}/{name}"], "this method predicts goals only")
    for rival in RIVALS:
        for name in SCORES:
            if name in scores[rival]:
                difference = interval(scores[OURS][name] - scores[rival][name])
                figures.put_mean(f"behavior/{OURS}_minus_{rival}/{name}", difference)


def _names() -> list[str]:
    return [f"behavior/{method}/{name}" for method in (OURS, *RIVALS) for name in SCORES]
