"""Scripted approaches in a home that training never saw: does the model's animal flee as often as the true
one?

Each approach has a twin in which the person stands still, from the same start; and the model is asked once
more with the person taken out of its perception.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from pipeline.behavior.config import PlanSamplingConfig
from pipeline.behavior.perception import FeatureVolume, world_from_ego
from pipeline.behavior.planning import observe
from pipeline.behavior.scenes import Scenes
from pipeline.behavior.trajectories import RATE_HZ, BehaviorData, Context
from pipeline.core.errors import InputError
from pipeline.data import npz
from pipeline.geometry import rigid
from pipeline.metrics.flight import flees
from pipeline.rivals.predictors import WINDOWS_AT_ONCE, Ats

TRUE = ("true", "true_standing")
"""names of what the animal itself did, by twin"""


@dataclass(frozen=True)
class RecordedApproaches:
    """What animal and person did; twin 0: the person walks up, twin 1: it stands."""

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


def check_rate(met: RecordedApproaches, data: BehaviorData, where: str) -> None:
    """Raise REC-002 for a model of another rate or past than the scripted approaches have."""
    past = met.observer.shape[2]
    if data.rate_hz != RATE_HZ or data.past != past:
        what = (
            f"approaches of {past} known frames at {RATE_HZ} Hz cannot be shown to a model of {data.past} "
            f"at {data.rate_hz:g} Hz"
        )
        remedy = "leave out `past_s` and `rate_hz` of [slice_behavior], or score without approaches"
        raise InputError("REC-002", what, where, remedy)


def shares(
    ats: Ats, met: RecordedApproaches, count: int, seed: int
) -> dict[str, Float[np.ndarray, "approach"]]:
    """Return per approach the share of ``count`` plans that flee, by what is perceived, and whether the
    animal fled.
    """
    ats = replace(ats, volume=met.scene)
    unaware = replace(ats.sampling, observer=False)
    asked = ({"seen": ats.sampling, "unseen": unaware}, {"standing": ats.sampling})
    found, past = {}, met.observer.shape[2]
    for twin, samplings in enumerate(asked):
        context = Context(met.world_from_agent[twin, :, :past], met.agent_from_bone[twin], met.observer[twin])
        fled = _fled(ats, context, samplings, count, seed)
        root = met.world_from_agent[twin, :, :, :3, 3]
        true = flees(root[:, past:], root[:, past - 1], met.observer[twin, :, -1]).astype(float)
        found |= {f"flees/{name}": share for name, share in fled.items()} | {f"flees/{TRUE[twin]}": true}
    return found


def _fled(
    ats: Ats, context: Context, samplings: dict[str, PlanSamplingConfig], count: int, seed: int
) -> dict[str, Float[np.ndarray, "approach"]]:
    """Return per approach the share of plans that flee, for several ways of sampling that begin with the same
    noise.
    """
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
