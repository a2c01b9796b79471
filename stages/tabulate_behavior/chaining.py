"""Plans chained for minutes beside the observer of a test recording: does the animal stay, and move as it does?"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float
from scipy.stats import ks_2samp

from pipeline.models.predictors import Ats
from pipeline.models.scenes import Scenes
from pipeline.models.simulator import Chaining, Simulator
from pipeline.models.trajectories import RATE_HZ, TEST, TRAIN, BehaviorData

REST_M_S = 0.05
"""speed below which an animal rests: it breathes, and reconstructions err by more"""


def figures(ats: Ats, data: BehaviorData, scenes: Scenes, *, count: int, seconds: float, seed: int) -> dict[str, float]:
    """Return the share of time inside something solid or outside, and Kolmogorov-Smirnov distances of speeds.

    Truth against truth compares each test recording (each half, if there is one) with the others. ``moving`` counts all
    speeds of an animal that rests as one.
    """
    videos = sorted({int(video) for video in data.video[data.split == TEST]})
    recorded = [data.trajectories[data.videos[video]] for video in videos]
    lived = [_rollout(ats, data, scenes, videos[number % len(videos)], seconds, seed + number) for number in range(count)]
    solid = [scenes.inside_solid(life[None], np.array([videos[n % len(videos)]])).mean() for n, life in enumerate(lived)]
    true = [_speeds(t.world_from_agent[t.valid, :3, 3]) for t in recorded]
    speeds, whole = [_speeds(life) for life in lived], np.concatenate(true)
    return {
        "behavior/ats/chain_rollouts": float(count),
        "behavior/ats/chain_seconds": float(seconds),
        "behavior/ats/chain_solid_share": float(np.mean(solid)),
        "behavior/ats/chain_solid_share_worst": float(np.max(solid)),
        "behavior/ats/chain_speed_ks": float(np.mean([_apart(each, whole) for each in speeds])),
        "behavior/ats/chain_speed_ks_pooled": _apart(np.concatenate(speeds), whole),
        "behavior/ats/chain_moving_speed_ks": float(np.mean([_apart(each, whole, REST_M_S) for each in speeds])),
        "behavior/ats/chain_moving_speed_ks_pooled": _apart(np.concatenate(speeds), whole, REST_M_S),
        "behavior/ats/chain_rest_share": float(np.mean(np.concatenate(speeds) < REST_M_S)),
        "behavior/true/chain_speed_ks": _among(true),
        "behavior/true/chain_moving_speed_ks": _among(true, REST_M_S),
        "behavior/true/chain_rest_share": float(np.mean(whole < REST_M_S)),
    }


def _rollout(ats: Ats, data: BehaviorData, scenes: Scenes, video: int, seconds: float, seed: int) -> Float[np.ndarray, "frame 3"]:
    """Let the model live in the home of a test recording, with its observer walking as recorded, over and over."""
    number = int(scenes.number(np.array([video]), 1)[0])
    mine = data.video == video
    there = replace(data, video=data.video[mine], start=data.start[mine], split=np.full(int(mine.sum()), TRAIN))
    simulator = Simulator(
        ats.sampler, there, scenes.volumes[number], scenes.allowed[number], ats.ego, sampling=ats.sampling, chaining=Chaining()
    )
    state = simulator.reset(seed)
    walk = data.trajectories[data.videos[video]].world_from_camera[:, :3, 3]
    begin = int(np.random.default_rng(seed).integers(len(walk)))
    path = [state.world_from_agent[:3, 3]]
    for step in range(round(seconds * RATE_HZ)):
        state = simulator.step(walk[(begin + step) % len(walk)])
        path.append(state.world_from_agent[:3, 3])
    return np.array(path)


def _speeds(path: Float[np.ndarray, "frame 3"]) -> Float[np.ndarray, "step"]:
    return np.linalg.norm(np.diff(path, axis=0), axis=-1) * RATE_HZ


def _apart(mine: Float[np.ndarray, "step"], others: Float[np.ndarray, "other"], least: float = 0.0) -> float:
    return float(ks_2samp(np.maximum(mine, least), np.maximum(others, least)).statistic)


def _among(recorded: list[Float[np.ndarray, "step"]], least: float = 0.0) -> float:
    parts = recorded if len(recorded) > 1 else np.array_split(recorded[0], 2)
    others = [np.concatenate([part for other, part in enumerate(parts) if other != mine]) for mine in range(len(parts))]
    return float(np.mean([_apart(part, rest, least) for part, rest in zip(parts, others, strict=True)]))
