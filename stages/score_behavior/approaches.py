"""Flight from scripted approaches in a held-out home: frequencies of the model and of the true animal.

Each approach has a twin from the same start in which the person stands still; the model also samples plans
without perceiving the person.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from pipeline.baselines.predictors import WINDOWS_AT_ONCE, Ats
from pipeline.behavior.config import PlanSamplingConfig
from pipeline.behavior.perception import FeatureVolume, world_from_ego
from pipeline.behavior.planning import observe
from pipeline.behavior.scenes import Scenes
from pipeline.behavior.trajectories import RATE_HZ, BehaviorData, Context
from pipeline.core.errors import InputError
from pipeline.data import npz
from pipeline.geometry import rigid
from pipeline.metrics.flight import flees

TRUE = ("true", "true_standing")
"""names of the scores of the true animal, by twin"""


@dataclass(frozen=True)
class RecordedApproaches:
    """Recorded motion of animal and person; twin 0: the person approaches, twin 1: it stands."""

    world_from_agent: Float[np.ndarray, "twin approach frame 4 4"]
    agent_from_bone: Float[np.ndarray, "twin approach past bone 4 4"]
    observer: Float[np.ndarray, "twin approach past 3"]
    scene: Scenes


def read(folder: Path) -> RecordedApproaches:
    """Read `approaches.npz` and its home. Raises InputError ART-010 when damaged."""
    names = ("world_from_agent", "agent_from_bone", "observer")
    return RecordedApproaches(
        **npz.load(folder / "approaches.npz", names),
        scene=Scenes.of(FeatureVolume.load(folder / "volume.npz")),
    )


def check_rate(recorded: RecordedApproaches, data: BehaviorData, where: str) -> None:
    """Raise REC-002 if the model has another rate or past than the scripted approaches."""
    past = recorded.observer.shape[2]
    if data.rate_hz != RATE_HZ or data.past != past:
        what = (
            f"approaches of {past} known frames at {RATE_HZ} Hz cannot be shown to a model of {data.past} "
            f"at {data.rate_hz:g} Hz"
        )
        remedy = "leave out `past_s` and `rate_hz` of [slice_behavior], or score without approaches"
        raise InputError("REC-002", what, where, remedy)


def flight_shares(
    ats: Ats, recorded: RecordedApproaches, count: int, seed: int
) -> dict[str, Float[np.ndarray, "approach"]]:
    """Return per approach the share of ``count`` plans that flee, and whether the animal fled."""
    ats = replace(ats, volume=recorded.scene)
    unaware = replace(ats.sampling, observer=False)
    conditions = ({"seen": ats.sampling, "unseen": unaware}, {"standing": ats.sampling})
    found, past = {}, recorded.observer.shape[2]
    for twin, samplings in enumerate(conditions):
        context = Context(
            recorded.world_from_agent[twin, :, :past], recorded.agent_from_bone[twin], recorded.observer[twin]
        )
        fled = _flight_shares(ats, context, samplings, count, seed)
        root = recorded.world_from_agent[twin, :, :, :3, 3]
        true = flees(root[:, past:], root[:, past - 1], recorded.observer[twin, :, -1]).astype(float)
        found |= {f"flees/{name}": share for name, share in fled.items()} | {f"flees/{TRUE[twin]}": true}
    return found


def _flight_shares(
    ats: Ats, context: Context, samplings: dict[str, PlanSamplingConfig], count: int, seed: int
) -> dict[str, Float[np.ndarray, "approach"]]:
    """Return per approach the share of plans that flee, by sampling settings, with the same noise."""
    rngs = {name: np.random.default_rng(seed) for name in samplings}
    parts: dict[str, list[np.ndarray]] = {name: [] for name in samplings}
    for begin in range(0, len(context), WINDOWS_AT_ONCE):
        some = context[begin : begin + WINDOWS_AT_ONCE]
        observation = observe(some, ats.volume, ats.agent_from_bone_rest, ats.ego)
        frame = np.repeat(world_from_ego(some.world_from_agent[:, -1], ats.ego), count, axis=0)
        now, person = some.world_from_agent[:, -1:, :3, 3], some.observer_world[:, -1:]
        for name, sampling in samplings.items():
            sampled = ats.sampler.plan_paths(observation, sampling, rngs[name], count=count)
            path = rigid.apply(frame, sampled).reshape(len(some), count, -1, 3)
            parts[name].append(
                flees(path, np.repeat(now, count, axis=1), np.repeat(person, count, axis=1)).mean(1)
            )
    return {name: np.concatenate(each) for name, each in parts.items()}
