"""Reading what `reconstruct` and `read_trajectories` promise to the behaviour models."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from pipeline.behavior.perception import FeatureVolume
from pipeline.core.errors import InputError
from pipeline.data import npz
from pipeline.data.templates import bones_at_rest
from stages.slice_behavior.gridding import ReconstructedMotion


@dataclass(frozen=True)
class BehaviorSource:
    """Motion per recording, and the scenes around it."""

    motions: dict[str, ReconstructedMotion]
    agent_from_bone_rest: Float[np.ndarray, "bone 4 4"]
    volumes: tuple[FeatureVolume, ...]
    """One for all recordings, or one for each, in their order."""
    where: str
    """For messages."""


def read_reconstruction(folder: Path, sessions: Sequence[str]) -> BehaviorSource:
    """Read the sessions that were reconstructed, all in one scene. Raises InputError ART-010 when damaged."""
    motions = {id: read_motion(folder / id) for id in sessions if (folder / id).is_dir()}
    return BehaviorSource(
        motions, _rest(folder), (FeatureVolume.load(folder / "feature_volume.npz"),), str(folder)
    )


def read_tables(folders: Mapping[str, Path]) -> BehaviorSource:
    """Read recordings with a scene each. Raises BEH-002 when they are not of the same body, ART-010 when
    damaged.
    """
    motions = {id: read_motion(folder) for id, folder in folders.items()}
    first, *others = folders.values()
    rest = _rest(first)
    for folder in others:
        if _rest(folder).shape != rest.shape:
            what = f"has {len(_rest(folder))} bones where {first} has {len(rest)}"
            raise InputError(
                "BEH-002", what, str(folder), "give one agent recordings of one body and one kind only"
            )
    volumes = tuple(FeatureVolume.load(folder / "feature_volume.npz") for folder in folders.values())
    return BehaviorSource(motions, rest, volumes, str(first.parent))


def read_motion(folder: Path) -> ReconstructedMotion:
    """Read the motion of one recording. Raises InputError ART-010 when damaged."""
    numbers = ("timestamp_s", "world_from_camera", "world_from_agent", "agent_from_bone", "confidence")
    loaded = npz.load(folder / "motion.npz", (*numbers, "agent_visible"), ("companions",))
    arrays = (np.asarray(loaded[name], np.float64) for name in numbers)
    visible = loaded["agent_visible"].astype(bool)
    return ReconstructedMotion(*arrays, agent_visible=visible, companions=loaded.get("companions"))


def _rest(folder: Path) -> Float[np.ndarray, "bone 4 4"]:
    return np.asarray(bones_at_rest(folder), np.float32)
