"""Samples of the behaviour model before and after optimisation: penetration, foot skate, errors."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from pipeline.behavior.config import Ego, PlanSamplingConfig
from pipeline.behavior.model import ROOT_CHANNELS, bones_from_channels
from pipeline.behavior.perception import world_from_ego
from pipeline.behavior.planning import Sampler, observe
from pipeline.behavior.scenes import Scenes
from pipeline.behavior.trajectories import FUTURE, RATE_HZ, BehaviorData
from pipeline.core import progress
from pipeline.longterm.config import MotionOptimizationConfig
from pipeline.longterm.journeys import LongTermWorld, refine_at_rate
from pipeline.longterm.short_motions import BodyMotion
from pipeline.metrics.intervals import bootstrapped, episodes, names_of

NAMES = ("penetration", "slide", "goal_error", "path_error")
UNITS = ("m", "m_s", "m", "m")


@dataclass(frozen=True)
class SampledModel:
    """A behaviour model, recorded windows to ask it on, and the world in which samples are made physical."""

    world: LongTermWorld
    sampler: Sampler
    data: BehaviorData
    scenes: Scenes
    ego: Ego
    windows: Int[np.ndarray, "window"]


def figures(
    asked: SampledModel, settings: MotionOptimizationConfig, *, draws: int, seed: int
) -> dict[str, float | None]:
    """Draw one plan per window, make it physical, and compare penetration, sliding feet and distances from
    the truth.

    `<name>_before_<unit>`, `<name>_<unit>` and `<name>_more_<unit>`, the second less the first, with
    intervals over episodes.
    """
    both, data, windows = rows(asked, settings, seed), asked.data, asked.windows
    episode = episodes(data.start[windows], data.video[windows], FUTURE)
    found: dict[str, float | None] = {"longterm_samples/windows": float(len(windows))}
    for column, (name, unit) in enumerate(zip(NAMES, UNITS, strict=True)):
        before, after = both[..., column].T
        for ending, values in (("_before", before), ("", after), ("_more", after - before)):
            key, known = f"longterm_samples/{name}{ending}_{unit}", np.isfinite(values)
            groups = np.unique(episode[known], return_inverse=True)[1]
            if known.any():
                rng = np.random.default_rng(seed)
                found |= bootstrapped(values[known], groups, draws, rng).as_figures(key)
            else:
                found |= dict.fromkeys(names_of(key))
    return found


def rows(
    asked: SampledModel, settings: MotionOptimizationConfig, seed: int
) -> Float[np.ndarray, "window 2 4"]:
    """Return `NAMES` of each window's plan before and after."""
    data = asked.data
    context, future = data.windows(asked.windows)
    observation = observe(context, asked.scenes, data.agent_from_bone_rest, asked.ego)
    plan = asked.sampler.plan(observation, PlanSamplingConfig(), np.random.default_rng(seed))
    roots = plan.world_from_agent(world_from_ego(context.world_from_agent[:, -1], asked.ego))
    bones = bones_from_channels(plan.body[..., ROOT_CHANNELS:], data.agent_from_bone_rest)
    count = min(roots.shape[1], future.path_world.shape[1])
    time_s, found = np.arange(count) / RATE_HZ, []
    plans = zip(roots[:, :count], bones[:, :count], future.path_world[:, :count], strict=True)
    for root, bone, truth in progress.track(plans, "samples", total=len(roots)):
        done, *worth = refine_at_rate(asked.world, time_s, BodyMotion(root, bone), settings)
        off = [np.linalg.norm(each[:, :3, 3] - truth, axis=1) for each in (root, done.world_from_agent)]
        both = zip(worth, off, strict=True)
        found.append([[each.penetration_m, each.slide_m_s, away[-1], away.mean()] for each, away in both])
    return np.array(found)
