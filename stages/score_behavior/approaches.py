"""Scripted approaches in a home that training never saw: does the model's animal flee as often as the true one?

Each approach has a twin in which the person stands still, from the same start; and the model is asked once more with
the person taken out of its perception.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float

from pipeline.files import arrays
from pipeline.models.flight import flees
from pipeline.models.perception import FeatureVolume, world_from_ego
from pipeline.models.planning import observe
from pipeline.models.predictors import WINDOWS_AT_ONCE, Ats
from pipeline.models.scenes import Scenes
from pipeline.models.trajectories import PAST, Context
from pipeline.space import rigid


@dataclass(frozen=True)
class Approaches:
    """What animal and person did; twin 0: the person walks up, twin 1: it stands."""

    world_from_agent: Float[np.ndarray, "twin approach frame 4 4"]
    agent_from_bone: Float[np.ndarray, "twin approach past bone 4 4"]
    observer: Float[np.ndarray, "twin approach past 3"]
    scene: Scenes


def read(folder: Path) -> Approaches:
    """Read `approaches.npz` and its home. Raises InputError ART-010 when damaged."""
    names = ("world_from_agent", "agent_from_bone", "observer")
    return Approaches(**arrays.load(folder / "approaches.npz", names), scene=Scenes.of(FeatureVolume.load(folder / "volume.npz")))


def shares(ats: Ats, met: Approaches, count: int, seed: int) -> dict[str, Float[np.ndarray, "approach"]]:
    """Return per approach the share of ``count`` plans that flee, by what is perceived, and whether the animal fled."""
    ats = replace(ats, volume=met.scene)
    unaware = replace(ats, sampling=replace(ats.sampling, observer=False))
    found = {}
    for name, model, twin in (("seen", ats, 0), ("unseen", unaware, 0), ("standing", ats, 1)):
        context = Context(met.world_from_agent[twin, :, :PAST], met.agent_from_bone[twin], met.observer[twin])
        found[f"flees/{name}"] = _fled(model, context, count, np.random.default_rng(seed))
    for name, twin in (("true", 0), ("true_standing", 1)):
        root = met.world_from_agent[twin, :, :, :3, 3]
        found[f"flees/{name}"] = flees(root[:, PAST:], root[:, PAST - 1], met.observer[twin, :, -1]).astype(float)
    return found


def _fled(ats: Ats, context: Context, count: int, rng: np.random.Generator) -> Float[np.ndarray, "approach"]:
    parts = []
    for begin in range(0, len(context), WINDOWS_AT_ONCE):
        some = context[begin : begin + WINDOWS_AT_ONCE]
        path = _paths(ats, some, count, rng)
        now, person = some.world_from_agent[:, -1:, :3, 3], some.observer_world[:, -1:]
        parts.append(flees(path, np.repeat(now, count, axis=1), np.repeat(person, count, axis=1)).mean(1))
    return np.concatenate(parts)


def _paths(ats: Ats, context: Context, count: int, rng: np.random.Generator) -> Float[np.ndarray, "window sample frame 3"]:
    """Sample paths without bodies, where the model knows them apart."""
    observation = observe(context, ats.volume, ats.agent_from_bone_rest, ats.ego)
    path = ats.sampler.course(observation, ats.sampling, rng, count=count)
    frame = np.repeat(world_from_ego(context.world_from_agent[:, -1], ats.ego), count, axis=0)
    return rigid.apply(frame, path).reshape(len(context), count, -1, 3)
