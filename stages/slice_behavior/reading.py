"""Reading of the motion and scenes that `reconstruct` and `read_trajectories` wrote."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType

import numpy as np
from jaxtyping import Float, Shaped

from pipeline.behavior.perception import FeatureVolume
from pipeline.behavior.trajectories import KINDS
from pipeline.core.errors import InputError
from pipeline.data import npz
from pipeline.data.clips import PEOPLE
from pipeline.data.templates import bones_at_rest
from pipeline.geometry import rigid
from stages.slice_behavior.gridding import ReconstructedMotion

PHONE_M = 1.4
"""height of a phone above the floor; people are perceived at that height, as the observer is"""


@dataclass(frozen=True)
class BehaviorSource:
    """Motion of each recording, and their scenes."""

    motions: dict[str, ReconstructedMotion]
    agent_from_bone_rest: Float[np.ndarray, "bone 4 4"]
    volumes: tuple[FeatureVolume, ...]
    """One for all recordings, or one for each in order."""
    where: str
    """Path for messages."""


def read_reconstruction(
    folder: Path,
    sessions: Sequence[str],
    others: Mapping[str, Path],
    min_confidence: float,
    masks: Mapping[str, Path] = MappingProxyType({}),
) -> BehaviorSource:
    """Read the reconstructed sessions, all in one scene; other animals of the home and people are companions.

    Raises InputError ART-010 when damaged.
    """
    motions = {id: read_motion(folder / id) for id in sessions if (folder / id).is_dir()}
    for id, motion in motions.items():
        present = [read_motion(other / id) for other in others.values() if (other / id).is_dir()]
        tracks = [companion_of(each, motion.timestamp_s, min_confidence) for each in present]
        if id in masks and (masks[id] / "people.npz").exists():
            tracks += people_of(PEOPLE.load(masks[id] / "people.npz"), motion)
        if tracks:
            motions[id] = replace(motion, companions=np.stack(tracks, axis=1))
    return BehaviorSource(
        motions, _rest(folder), (FeatureVolume.load(folder / "feature_volume.npz"),), str(folder)
    )


def companion_of(
    motion: ReconstructedMotion, timestamp_s: Float[np.ndarray, "frame"], min_confidence: float
) -> Float[np.ndarray, "frame 4"]:
    """Return position and kind of another animal at these times of the same recording.

    NaN where it is not visible or its confidence is lower.
    """
    found = np.full((len(timestamp_s), 4), np.nan)
    trusted = motion.agent_visible & (motion.confidence >= min_confidence)
    same, mine, its = np.intersect1d(timestamp_s, motion.timestamp_s[trusted], return_indices=True)
    assert len(same) or not trusted.any(), "both come from the same frames"
    found[mine, :3] = motion.world_from_agent[trusted][its, :3, 3]
    found[mine, 3] = KINDS.index("animal")
    return found


def people_of(
    people: dict[str, Shaped[np.ndarray, "..."]], motion: ReconstructedMotion
) -> list[Float[np.ndarray, "frame 4"]]:
    """Return position, at phone height, and kind of each person at the times of a motion.

    NaN where the person is not visible or the camera is unknown.
    """
    _, mine, its = np.intersect1d(motion.timestamp_s, people["timestamp_s"], return_indices=True)
    found = []
    for feet_camera in people["feet_camera"].transpose(1, 0, 2):
        track = np.full((len(motion.timestamp_s), 4), np.nan)
        track[mine, :3] = rigid.apply(motion.world_from_camera[mine], feet_camera[its, None])[:, 0]
        track[:, 1] += PHONE_M
        track[np.isfinite(track[:, 0]), 3] = KINDS.index("person")
        found.append(track)
    return found


def read_tables(folders: Mapping[str, Path]) -> BehaviorSource:
    """Read recordings with a scene each. Raises BEH-002 for different skeletons, ART-010 when damaged."""
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
