"""Samples of the behaviour model before and after they are made physical: penetration, sliding feet, goal and path errors."""

import numpy as np

from pipeline.models.behavior import ROOT_CHANNELS, Sampling, bones_from_channels
from pipeline.models.journeys import World, physical
from pipeline.models.motion_optimization import Settings
from pipeline.models.perception import Ego, world_from_ego
from pipeline.models.planning import Sampler, observe
from pipeline.models.scenes import Scenes
from pipeline.models.short_motions import Moving
from pipeline.models.trajectories import RATE_HZ, BehaviorData


def figures(
    world: World, sampler: Sampler, data: BehaviorData, scenes: Scenes, ego: Ego, windows: np.ndarray, settings: Settings, seed: int
) -> dict[str, float | None]:
    """Draw one plan per window, make it physical, and compare penetration, sliding feet and distances from the truth."""
    context, future = data.windows(windows)
    observation = observe(context, scenes, data.agent_from_bone_rest, ego)
    plan = sampler.plan(observation, Sampling(), np.random.default_rng(seed))
    roots = plan.world_from_agent(world_from_ego(context.world_from_agent[:, -1], ego))
    bones = bones_from_channels(plan.body[..., ROOT_CHANNELS:], data.agent_from_bone_rest)
    count = min(roots.shape[1], future.path_world.shape[1])
    time_s, rows = np.arange(count) / RATE_HZ, []
    for root, bone, truth in zip(roots[:, :count], bones[:, :count], future.path_world[:, :count], strict=True):
        done, before, after = physical(world, time_s, Moving(root, bone), settings)
        off = [np.linalg.norm(each[:, :3, 3] - truth, axis=1) for each in (root, done.world_from_agent)]
        rows.append(
            [
                before.penetration_m,
                after.penetration_m,
                before.slide_m_s,
                after.slide_m_s,
                *(each[-1] for each in off),
                *(each.mean() for each in off),
            ]
        )
    mean = np.nanmean(np.array(rows), axis=0)
    names = (
        "penetration_before_m",
        "penetration_m",
        "slide_before_m_s",
        "slide_m_s",
        "goal_error_before_m",
        "goal_error_m",
        "path_error_before_m",
        "path_error_m",
    )
    found = dict(zip(names, mean.tolist(), strict=True)) | {"windows": float(len(rows))}
    return {f"longterm_samples/{name}": value if np.isfinite(value) else None for name, value in found.items()}
