"""Samples of the behavior model before and after optimization: penetration, foot skate, errors."""

from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from pipeline.baselines.predictors import Ats
from pipeline.behavior.config import PlanSamplingConfig
from pipeline.behavior.model import ROOT_CHANNELS, bones_from_channels
from pipeline.behavior.perception import world_from_ego
from pipeline.behavior.scenes import Scenes
from pipeline.behavior.trajectories import RATE_HZ, TEST, BehaviorData
from pipeline.core import progress
from pipeline.geometry import subsampling
from pipeline.longterm.journeys import LongTermWorld, refine_at_rate
from pipeline.longterm.short_motions import BodyMotion
from pipeline.metrics.intervals import bootstrapped, episodes
from stages.tabulate_longterm.config import Config
from stages.tabulate_longterm.reading import MotionSource

NAMES = ("penetration", "slide", "goal_error", "path_error")
UNITS = ("m", "m_s", "m", "m")


def figures(
    source: MotionSource, model: Path, behavior_data: Path, config: Config, device: str
) -> dict[str, float | None]:
    """Sample one plan per test window, optimize it, and compare penetration, foot skate and errors.

    Returns `<name>_before_<unit>`, `<name>_<unit>` and their difference `<name>_more_<unit>`, with intervals
    over episodes; nothing without a test window.
    """
    data = source.data
    assert data is not None, "only recorded motion has samples of the behavior model"
    windows = data.indices(TEST)
    if not len(windows):
        progress.log("no test window: samples of the behavior model are not measured")
        return {}
    windows = windows[subsampling.evenly(len(windows), config.samples)]
    both = rows(source.world, data, windows, model, behavior_data, config, device)
    episode = episodes(data.start[windows], data.video[windows], data.past + data.future)
    found: dict[str, float | None] = {"longterm_samples/windows": float(len(windows))}
    for column, (name, unit) in enumerate(zip(NAMES, UNITS, strict=True)):
        before, after = both[..., column].T
        for ending, values in (("_before", before), ("", after), ("_more", after - before)):
            interval = bootstrapped(values, episode, np.random.default_rng(config.seed))
            found |= interval.as_figures(f"longterm_samples/{name}{ending}_{unit}")
    return found


def rows(
    world: LongTermWorld,
    data: BehaviorData,
    windows: Int[np.ndarray, "window"],
    model: Path,
    behavior_data: Path,
    config: Config,
    device: str,
) -> Float[np.ndarray, "window 2 4"]:
    """Return `NAMES` of each window's plan before and after optimization."""
    ats = Ats.load(model, Scenes.load(behavior_data, data.videos), PlanSamplingConfig(), device=device)
    context, future = data.windows(windows)
    plan = ats.sampler.plan(ats.observe(context), ats.sampling, np.random.default_rng(config.seed))
    roots = plan.world_from_agent(world_from_ego(context.world_from_agent[:, -1], ats.ego))
    bones = bones_from_channels(plan.body[..., ROOT_CHANNELS:], data.agent_from_bone_rest)
    count = min(roots.shape[1], future.path_world.shape[1])
    time_s, found = np.arange(count) / RATE_HZ, []
    plans = zip(roots[:, :count], bones[:, :count], future.path_world[:, :count], strict=True)
    for root, bone, truth in progress.track(plans, "samples", total=len(roots)):
        refined, *metrics = refine_at_rate(world, time_s, BodyMotion(root, bone), config.optimization)
        errors = [np.linalg.norm(each[:, :3, 3] - truth, axis=1) for each in (root, refined.world_from_agent)]
        both = zip(metrics, errors, strict=True)
        found.append([[each.penetration_m, each.slide_m_s, error[-1], error.mean()] for each, error in both])
    return np.array(found)
