"""Scores of sampled futures: best of K (minDE, minADE), and the energy score, a proper scoring rule.

Each returns one number per window; the paper averages them over trials and all test windows.
"""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Int

from pipeline.baselines.predictors import WINDOWS_AT_ONCE, Ats, Predictor, Samples
from pipeline.behavior.trajectories import BehaviorData, Future
from pipeline.geometry import rigid

GOAL_SCORES = ("goal_minde_m", "goal_energy_score_m")
PLAN_SCORES = ("path_minade_m", "orientation_minade_rad", "joints_minade_rad")


def goal_distances(samples: Samples, future: Future) -> Float[np.ndarray, "window sample"]:
    """Return the distance of every sampled goal, meters."""
    return np.linalg.norm(samples.goal - future.goal_world[:, None], axis=-1)


def goal_minde(samples: Samples, future: Future) -> Float[np.ndarray, "window"]:
    """Return the distance of the best of the sampled goals, meters."""
    return goal_distances(samples, future).min(1)


def goal_energy_score(samples: Samples, future: Future) -> Float[np.ndarray, "window"]:
    """Return E|X - y| - E|X - X'| / 2 (Gneiting & Raftery 2007), the second term unbiased."""
    count = samples.goal.shape[1]
    to_truth = goal_distances(samples, future).mean(1)
    among = np.linalg.norm(samples.goal[:, :, None] - samples.goal[:, None], axis=-1).sum((1, 2))
    return to_truth - among / (2 * count * (count - 1))


def path_minade(samples: Samples, future: Future) -> Float[np.ndarray, "window"]:
    """Return the mean distance along the best of the sampled paths, meters."""
    away = np.linalg.norm(_predicted(samples.path) - future.path_world[:, None], axis=-1)
    return away.mean(-1).min(1)


def orientation_minade(samples: Samples, future: Future) -> Float[np.ndarray, "window"]:
    """Return the mean geodesic angle of the root along the best sample, radians."""
    rotation = _predicted(samples.rotation)
    true = np.broadcast_to(future.world_from_agent[:, None, :, :3, :3], rotation.shape)
    return rigid.rotation_angle(rotation, true).mean(-1).min(1)


def joints_minade(samples: Samples, future: Future) -> Float[np.ndarray, "window"]:
    """Return the mean geodesic angle of the bones along the best sample, radians."""
    bones = _predicted(samples.agent_from_bone)
    true = np.broadcast_to(future.agent_from_bone[:, None], bones.shape)
    return rigid.rotation_angle(bones[..., :3, :3], true[..., :3, :3]).mean((-1, -2)).min(1)


def _predicted(part: np.ndarray | None) -> np.ndarray:
    assert part is not None, "the method does not predict this"
    return part


SCORES: dict[str, Callable[[Samples, Future], Float[np.ndarray, "window"]]] = {
    "goal_minde_m": goal_minde,
    "goal_energy_score_m": goal_energy_score,
    "path_minade_m": path_minade,
    "orientation_minade_rad": orientation_minade,
    "joints_minade_rad": joints_minade,
}
"""All scores by name of the metric."""


def scored(
    method: Predictor,
    data: BehaviorData,
    goal_windows: Int[np.ndarray, "goal_window"],
    plan_windows: Int[np.ndarray, "plan_window"],
    *,
    samples: int,
    trials: int,
    seed: int,
) -> dict[str, Float[np.ndarray, "window"]]:
    """Score goals, mean over trials of ``samples``, and one trial of plans if the method draws any, each on
    windows of its own.
    """
    found: dict[str, list[np.ndarray]] = {name: [] for name in SCORES}
    rng = np.random.default_rng(seed)
    draw = method.goals if isinstance(method, Ats) else method.sample
    for window in _chunks(goal_windows):
        context, future = data.windows(window)
        goals = draw(context, samples * trials, rng).goal.copy()  # may be a view of paths, which this frees
        drawn = np.split(goals, trials, axis=1)
        for name in GOAL_SCORES:
            found[name].append(np.mean([SCORES[name](Samples(trial), future) for trial in drawn], axis=0))
    for window in _chunks(plan_windows):
        context, future = data.windows(window)
        plans = method.sample(context, samples, rng)
        for name in PLAN_SCORES if plans.path is not None else ():
            found[name].append(SCORES[name](plans, future))
    return {name: np.concatenate(parts) for name, parts in found.items() if parts}


def _chunks(windows: Int[np.ndarray, "window"]) -> list[Int[np.ndarray, "some"]]:
    return [windows[begin : begin + WINDOWS_AT_ONCE] for begin in range(0, len(windows), WINDOWS_AT_ONCE)]
