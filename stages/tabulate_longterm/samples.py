"""Samples of the behaviour model before and after they are made physical: penetration, sliding feet, goal and path errors."""

import numpy as np
from jaxtyping import Float, Int

from pipeline import progress
from pipeline.models.behavior import ROOT_CHANNELS, Sampling, bones_from_channels
from pipeline.models.intervals import bootstrapped, episodes, names_of
from pipeline.models.journeys import World, physical
from pipeline.models.motion_optimization import Settings
from pipeline.models.perception import Ego, world_from_ego
from pipeline.models.planning import Sampler, observe
from pipeline.models.scenes import Scenes
from pipeline.models.short_motions import Moving
from pipeline.models.trajectories import FUTURE, RATE_HZ, BehaviorData

NAMES = ("penetration", "slide", "goal_error", "path_error")
UNITS = ("m", "m_s", "m", "m")


def figures(
    world: World,
    sampler: Sampler,
    data: BehaviorData,
    scenes: Scenes,
    ego: Ego,
    windows: Int[np.ndarray, "window"],
    settings: Settings,
    *,
    draws: int,
    seed: int,
) -> dict[str, float | None]:
    """Draw one plan per window, make it physical, and compare penetration, sliding feet and distances from the truth.

    `<name>_before_<unit>`, `<name>_<unit>` and `<name>_more_<unit>`, the second less the first, with intervals over episodes.
    """
    both = rows(world, sampler, data, scenes, ego, windows, settings, seed)
    episode = episodes(data.start[windows], data.video[windows], FUTURE)
    found: dict[str, float | None] = {"longterm_samples/windows": float(len(windows))}
    for column, (name, unit) in enumerate(zip(NAMES, UNITS, strict=True)):
        before, after = both[..., column].T
        for ending, values in (("_before", before), ("", after), ("_more", after - before)):
            key, known = f"longterm_samples/{name}{ending}_{unit}", np.isfinite(values)
            groups = np.unique(episode[known], return_inverse=True)[1]
            told = bootstrapped(values[known], groups, draws, np.random.default_rng(seed)).named(key) if known.any() else None
            found |= told or dict.fromkeys(names_of(key))
    return found


def rows(
    world: World,
    sampler: Sampler,
    data: BehaviorData,
    scenes: Scenes,
    ego: Ego,
    windows: Int[np.ndarray, "window"],
    settings: Settings,
    seed: int,
) -> Float[np.ndarray, "window 2 4"]:
    """Return `NAMES` of each window's plan before and after."""
    context, future = data.windows(windows)
    observation = observe(context, scenes, data.agent_from_bone_rest, ego)
    plan = sampler.plan(observation, Sampling(), np.random.default_rng(seed))
    roots = plan.world_from_agent(world_from_ego(context.world_from_agent[:, -1], ego))
    bones = bones_from_channels(plan.body[..., ROOT_CHANNELS:], data.agent_from_bone_rest)
    count = min(roots.shape[1], future.path_world.shape[1])
    time_s, found = np.arange(count) / RATE_HZ, []
    plans = zip(roots[:, :count], bones[:, :count], future.path_world[:, :count], strict=True)
    for root, bone, truth in progress.track(plans, "samples", total=len(roots)):
        done, *worth = physical(world, time_s, Moving(root, bone), settings)
        off = [np.linalg.norm(each[:, :3, 3] - truth, axis=1) for each in (root, done.world_from_agent)]
        found.append([[each.penetration_m, each.slide_m_s, away[-1], away.mean()] for each, away in zip(worth, off, strict=True)])
    return np.array(found)
