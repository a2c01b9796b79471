"""Reaction to the observer: shifts of sampled goals under approaching, far and absent observers.

The observer approaches from each side, stands beyond the radius of perception, or is dropped; scene, past and
noise are the same.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from pipeline.behavior.config import PlanSamplingConfig
from pipeline.behavior.model import Architecture, other_channels
from pipeline.behavior.perception import world_from_ego
from pipeline.behavior.planning import Observation, Sampler, observe
from pipeline.behavior.scenes import Scenes
from pipeline.behavior.trajectories import PAST, RATE_HZ, TRAIN, UP, BehaviorData
from pipeline.geometry import rigid, subsampling

SAMPLES = 16
CLOSE_M, WALK_M_S = 0.8, 1.0
"""Distance and speed of an approaching observer."""
SIDES = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]])
"""directions of approach, ego frame: ahead, left, behind, right"""


@dataclass(frozen=True)
class Reactions:
    """Mean shifts of sampled goals in meters, over windows and sides."""

    away_m: float
    """along the direction away from an approaching observer, against no observer"""
    away_share: float
    """share of sides and windows in which it is positive"""
    reversal_m: float
    """between approaches from opposite sides, along the first one's direction away"""
    far_m: float
    """largest, any direction, of a far observer against none"""
    farther_m: float
    """largest, any direction, of a far observer against one twice as far"""


@dataclass(frozen=True)
class SampledMoments:
    """Some training windows, evenly spread, on which the model is evaluated."""

    observation: Observation
    world_from_ego: Float[np.ndarray, "window 4 4"]
    scene: Int[np.ndarray, "window"]
    """index of each window's feature volume"""


def moments(
    data: BehaviorData, scenes: Scenes, architecture: Architecture, count: int = 24
) -> SampledMoments:
    """Choose training windows and encode their observations."""
    train = data.indices(TRAIN)
    context, _ = data.windows(train[subsampling.evenly(len(train), count)])
    observation = observe(context, scenes, data.agent_from_bone_rest, architecture.ego)
    number = scenes.number(context.video, len(context))
    frame = world_from_ego(context.world_from_agent[:, -1], architecture.ego)
    return SampledMoments(observation, frame, number)


def approach(
    side: Float[np.ndarray, "3"],
    distance_m: float,
    speed_m_s: float,
    *,
    frames: int = PAST,
    rate_hz: float = RATE_HZ,
) -> Float[np.ndarray, "1 past_frame 10"]:
    """Return the past of an observer who approaches from ``side`` and looks at the animal; ego frame."""
    before_s = np.arange(frames - 1, -1, -1)[:, None] / rate_hz
    eye = (distance_m + speed_m_s * before_s) * side + UP
    return other_channels(rigid.look_at(eye, np.zeros(3), UP)[None])[0]


def measure(sampler: Sampler, observation: Observation, *, radius_m: float, seed: int) -> Reactions:
    """Sample goals of some windows under scripted observers with the same noise."""
    sampling = PlanSamplingConfig(guidance=1.0, avoid_solid=False)  # as learned, not amplified
    how = {"frames": observation.others.shape[2], "rate_hz": sampler.scaling.rate_hz}

    def mean_goals(
        observer: Float[np.ndarray, "1 past_frame 10"], sampling: PlanSamplingConfig
    ) -> Float[np.ndarray, "window 3"]:
        seen = replace(observation, others=np.tile(observer, (len(observation), 1, 1, 1)))
        goals = sampler.goals(sampler.codes(seen, sampling, SAMPLES), np.random.default_rng(seed))
        return goals.reshape(len(observation), SAMPLES, 3).mean(1)

    none = mean_goals(approach(SIDES[0], 1.0, 0.0, **how), replace(sampling, observer=False))
    coming = [approach(side, CLOSE_M, WALK_M_S, **how) for side in SIDES]
    shift = np.stack([mean_goals(observer, sampling) - none for observer in coming])
    away = -np.einsum("swc,sc->sw", shift, SIDES)
    opposite = np.roll(shift, -2, axis=0)
    reversal = -np.einsum("swc,sc->sw", shift - opposite, SIDES)
    far = mean_goals(approach(SIDES[0], radius_m, 0.0, **how), sampling)
    farther = mean_goals(approach(SIDES[0], 2 * radius_m, 0.0, **how), sampling)
    return Reactions(
        away_m=float(away.mean()),
        away_share=float((away > 0).mean()),
        reversal_m=float(reversal.mean()),
        far_m=float(np.linalg.norm(far - none, axis=-1).max()),
        farther_m=float(np.linalg.norm(far - farther, axis=-1).max()),
    )
