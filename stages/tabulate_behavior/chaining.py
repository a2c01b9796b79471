"""Long rollouts of chained plans beside the observer of a test recording, compared with recorded motion."""

from collections.abc import Sequence
from typing import cast

import numpy as np
from jaxtyping import Float, Int
from scipy.stats import ks_2samp

from pipeline.baselines.predictors import Ats
from pipeline.behavior.config import ReplanningConfig
from pipeline.behavior.path_encoding import REST_SPEED_M_S
from pipeline.behavior.scenes import Scenes
from pipeline.behavior.simulator import AnimalBatch
from pipeline.behavior.trajectories import TEST, BehaviorData

UPRIGHT_QUANTILE = 0.999
"""quantile of recorded tilts above which an animal counts as tilted"""


def figures(
    ats: Ats, data: BehaviorData, scenes: Scenes, *, count: int, seconds: float, seed: int
) -> dict[str, float]:
    """Return the share of time inside solid or unmapped space, and Kolmogorov-Smirnov distances of speeds.

    ``behavior/true`` compares each test recording (each half of a single one) with the others. ``moving``
    treats all speeds at rest as equal. ``tilted`` is the share of time with a tilt beyond nearly all recorded
    ones.
    """
    rng, test = np.random.default_rng(seed), data.indices(TEST)
    chosen = test[
        (np.arange(count) * len(test)) // count + rng.integers(max(len(test) // count, 1), size=count)
    ]
    poses = rollouts(ats, data, scenes, chosen, seconds, rng)
    position, tilt = poses[..., :3, 3], _tilts(poses)
    solid = scenes.inside_solid(position, data.video[chosen]).mean(1)
    recorded = [data.trajectories[data.videos[video]] for video in np.unique(data.video[test])]
    true = [_speeds(t.world_from_agent[:, :3, 3], data.rate_hz)[t.valid[1:] & t.valid[:-1]] for t in recorded]
    parts = true if len(true) > 1 else np.array_split(true[0], 2)
    others = [np.concatenate([*parts[:mine], *parts[mine + 1 :]]) for mine in range(len(parts))]
    tilted = np.quantile(
        np.concatenate([_tilts(t.world_from_agent[t.valid]) for t in recorded]), UPRIGHT_QUANTILE
    )
    speeds, whole = [_speeds(life, data.rate_hz) for life in position], np.concatenate(true)
    every = np.concatenate(speeds)
    return {
        "behavior/ats/chain_rollouts": float(count),
        "behavior/ats/chain_seconds": float(seconds),
        "behavior/ats/chain_solid_share": float(np.mean(solid)),
        "behavior/ats/chain_solid_share_worst": float(np.max(solid)),
        "behavior/ats/chain_speed_ks": _mean_ks(speeds, [whole] * count),
        "behavior/ats/chain_speed_ks_pooled": _mean_ks([every], [whole]),
        "behavior/ats/chain_moving_speed_ks": _mean_ks(speeds, [whole] * count, REST_SPEED_M_S),
        "behavior/ats/chain_moving_speed_ks_pooled": _mean_ks([every], [whole], REST_SPEED_M_S),
        "behavior/ats/chain_tilted_share": float(np.mean(tilt > tilted)),
        "behavior/ats/chain_rest_share": float(np.mean(every < REST_SPEED_M_S)),
        "behavior/true/chain_speed_ks": _mean_ks(parts, others),
        "behavior/true/chain_moving_speed_ks": _mean_ks(parts, others, REST_SPEED_M_S),
        "behavior/true/chain_rest_share": float(np.mean(whole < REST_SPEED_M_S)),
    }


def rollouts(
    ats: Ats,
    data: BehaviorData,
    scenes: Scenes,
    window: Int[np.ndarray, "life"],
    seconds: float,
    rng: np.random.Generator,
) -> Float[np.ndarray, "life frame 4 4"]:
    """Roll out the model from some windows in their homes; recorded others move in a loop."""
    rest, chaining = data.agent_from_bone_rest, ReplanningConfig()
    animals = AnimalBatch(ats.sampler, scenes, rest, ats.ego, sampling=ats.sampling, chaining=chaining)
    context, _ = data.windows(window)
    tracks = [data.trajectories[data.videos[video]] for video in data.video[window]]
    length = np.array([len(track.timestamp_s) for track in tracks])[:, None]
    animals.begin(context, rng, companions=context.companions)
    root = [context.world_from_agent[:, -1]]
    for step in range(1, round(seconds * data.rate_hz) + 1):
        frames = (data.start[window][:, None] + step + np.arange(data.past)) % length
        both = zip(tracks, frames[:, -1], strict=True)
        seen = np.array([track.world_from_camera[frame, :3, 3] for track, frame in both])
        root.append(animals.step(seen, data.companions(window, frames)).root[:, 0])
    return np.stack(root, axis=1)


def _tilts(world_from_agent: Float[np.ndarray, "*batch 4 4"]) -> Float[np.ndarray, "*batch"]:
    """Return the tilt of roots from upright, radians."""
    return np.arccos(np.clip(world_from_agent[..., 1, 1], -1, 1))


def _speeds(path: Float[np.ndarray, "frame 3"], rate_hz: float) -> Float[np.ndarray, "step"]:
    return np.linalg.norm(np.diff(path, axis=0), axis=-1) * rate_hz


def _mean_ks(
    mine: Sequence[Float[np.ndarray, "step"]],
    others: Sequence[Float[np.ndarray, "other"]],
    min_speed: float = 0.0,
) -> float:
    """Return the mean Kolmogorov-Smirnov distance of pairs; speeds under ``min_speed`` (m/s) are equal."""
    pairs = zip(mine, others, strict=True)
    found = [ks_2samp(np.maximum(a, min_speed), np.maximum(b, min_speed)) for a, b in pairs]
    return float(np.mean([cast("tuple[float, float]", each)[0] for each in found]))  # statistic and p-value
