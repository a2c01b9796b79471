"""Flight from scripted approaches in a held-out home: frequencies of the model and of the true animal.

Each approach has a twin from the same start in which the person stands still; the model also samples plans
without perceiving the person.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from pipeline.baselines.predictors import Ats
from pipeline.behavior.perception import FeatureVolume
from pipeline.behavior.scenes import Scenes
from pipeline.behavior.trajectories import RATE_HZ, BehaviorData, Context
from pipeline.core.errors import InputError
from pipeline.data import npz
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
    ats = replace(ats, scenes=recorded.scene)
    unaware = replace(ats.sampling, observer=False)
    conditions = ({"seen": ats.sampling, "unseen": unaware}, {"standing": ats.sampling})
    found, past = {}, recorded.observer.shape[2]
    for twin, samplings in enumerate(conditions):
        context = Context(
            recorded.world_from_agent[twin, :, :past], recorded.agent_from_bone[twin], recorded.observer[twin]
        )
        root, person = recorded.world_from_agent[twin, :, :, :3, 3], recorded.observer[twin, :, -1]
        for name, sampling in samplings.items():  # with the same noise
            path = replace(ats, sampling=sampling).paths(context, count, np.random.default_rng(seed)).path
            assert path is not None, "a behavior model samples paths"
            now, seen = (np.repeat(each[:, None], count, axis=1) for each in (root[:, past - 1], person))
            found[f"flees/{name}"] = flees(path, now, seen).mean(1)
        found[f"flees/{TRUE[twin]}"] = flees(root[:, past:], root[:, past - 1], person).astype(float)
    return found
