"""Protocols: end to end (Table 4), by plans as they are used and by the networks alone, and given the true
goal or path (Table 5).

Plans as they are used are projected out of solid space, snapped to their goals and drawn again where they
miss them. The paper does none of this, so the other two protocols leave it out.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Int, Shaped

from pipeline.baselines.predictors import WINDOWS_AT_ONCE, Ats, Samples, joined
from pipeline.behavior.perception import world_from_ego
from pipeline.behavior.planning import SampledPlan
from pipeline.behavior.trajectories import TEST, BehaviorData, Context, Future
from pipeline.geometry import rigid
from pipeline.metrics.scores import GOAL_SCORES, PLAN_SCORES, SCORES
from stages.score_behavior.config import Config

NETWORK_TRIALS = 2
"""trials of goals by the networks alone"""


def scores(
    ats: Ats, data: BehaviorData, family: str, scoring: Config
) -> dict[str, Shaped[np.ndarray, "..."]]:
    """Return one value per window for each protocol and score, averaged over trials, and the windows.

    Protocols are ``end_to_end``, ``networks`` and ``truth_fed``, see above. ``goal_window``, ``plan_window``:
    recording and first frame of the windows that goals, and plans, are scored on; ``window_frames``: numbers
    of past and future frames. ``samples``: of a window, the best of which counts. ``solid``: share of each
    window's sampled positions inside solid or unmapped space, which projection makes about zero.
    """
    rng, test = np.random.default_rng(scoring.seed), data.indices(TEST)
    many, few = test[:: scoring.stride], test[:: scoring.plan_stride]
    context, future = data.windows(many)
    alone, found = replace(ats, sampling=ats.sampling.networks_only()), {}
    for protocol, model, count in (("end_to_end", ats, scoring.trials), ("networks", alone, NETWORK_TRIALS)):
        goals = model.goals(context, scoring.samples * count, rng).goal
        trials = [Samples(part) for part in np.split(goals, count, axis=1)]
        found |= {f"{protocol}/{name}": [SCORES[name](t, future) for t in trials] for name in GOAL_SCORES}
    context, future = data.windows(few)
    samples = ats.sample(context, scoring.samples, rng)
    found |= {f"end_to_end/{name}": [SCORES[name](samples, future)] for name in PLAN_SCORES}
    paths = alone.paths(context, scoring.samples, rng)
    found["networks/path_minade_m"] = [SCORES["path_minade_m"](paths, future)]
    for protocol, made in (("end_to_end", samples), ("networks", paths)):
        assert made.path is not None, "a behavior model samples paths"
        found[f"{protocol}/solid"] = [ats.scenes.inside_solid(made.path, context.video).mean((1, 2))]
    if family != "one_stage":  # has no levels to condition on the truth
        fed = fed_with_truth(alone, context, future, scoring.samples, rng)
        found |= {f"truth_fed/{name}": [SCORES[name](fed, future)] for name in PLAN_SCORES}
    listed = {
        "goal_window": _listed(data, many),
        "plan_window": _listed(data, few),
        "videos": np.array(data.videos, np.str_),
        "window_frames": np.array([data.past, data.future], np.int32),
        "samples": np.array(scoring.samples, np.int32),
    }
    true = ats.scenes.inside_solid(future.path_world, context.video).mean(1)
    return (
        {name: np.mean(values, axis=0) for name, values in found.items()} | {"recorded/solid": true} | listed
    )


def fed_with_truth(
    ats: Ats, context: Context, future: Future, count: int, rng: np.random.Generator
) -> Samples:
    """Sample paths to the true goals, and bodies along the true paths."""
    parts = []
    for begin in range(0, len(context), WINDOWS_AT_ONCE):
        some = slice(begin, begin + WINDOWS_AT_ONCE)
        frame = world_from_ego(context[some].world_from_agent[:, -1], ats.ego)
        true = rigid.apply(rigid.inverse(frame), future.path_world[some])
        codes = ats.sampler.codes(ats.observe(context[some]), ats.sampling, count)
        path = ats.sampler.paths(codes, np.repeat(true[:, -1], count, axis=0), rng)
        body = ats.sampler.bodies(codes, np.repeat(true, count, axis=0), rng)
        parts.append(ats.in_world(SampledPlan(path[:, -1], path, body), context[some]))
    return joined(parts)


def _listed(data: BehaviorData, index: Int[np.ndarray, "window"]) -> Int[np.ndarray, "window 2"]:
    return np.stack([data.video[index], data.start[index]], axis=1).astype(np.int32)
