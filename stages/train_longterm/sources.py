"""Where motion comes from, parted into what is learned from and what is held out."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.behavior.trajectories import TRAIN, BehaviorData
from pipeline.core.errors import InputError
from pipeline.data import npz, ply
from pipeline.longterm import simulated_lives
from pipeline.longterm.examples import MotionDataset, reconstructed_dataset
from pipeline.longterm.short_motions import resample_motion
from pipeline.longterm.smplx_bodies import motion_from_parameters, smplx_body
from pipeline.longterm.surroundings import MotionScene
from stages.train_longterm import prox

STUDY_REACH_M = 1.5
"""heights of the synthetic study's scene that are used, above and below where bodies have been"""


@dataclass(frozen=True)
class DatasetSplit:
    """Motion to learn from and motion held out; the latter may be nothing."""

    train: MotionDataset
    held_out: MotionDataset | None


def recorded(reconstruction: Path, behavior_data: Path) -> DatasetSplit:
    """Read reconstructed sessions, those of the behaviour test held out. Raises LTM-001 without motion."""
    data = BehaviorData.load(behavior_data)
    dataset, video_of = reconstructed_dataset(reconstruction, data)
    learns = {data.videos[video] for video in np.unique(data.video[data.split == TRAIN])}
    train = [index for index, video in enumerate(video_of) if video in learns]
    if not train:
        remedy = "record longer sessions in which the animal stays in view"
        raise InputError(
            "LTM-001", "no two seconds of uninterrupted motion to learn from", str(behavior_data), remedy
        )
    rest = [index for index, video in enumerate(video_of) if video not in learns]
    return DatasetSplit(dataset.subset(train), dataset.subset(rest) if rest else None)


def simulated(folder: Path) -> DatasetSplit:
    """Read simulated motion; homes and sessions that are not for training are held out."""
    dataset, split = simulated_lives.load(folder)
    held = np.flatnonzero(np.array(split) != "train")
    return DatasetSplit(
        dataset.subset(np.flatnonzero(np.array(split) == "train")),
        dataset.subset(held) if len(held) else None,
    )


def people(model: Path, folder: Path) -> DatasetSplit:
    """Read recorded SMPL-X motion: `scene.ply` and `*.npz` of one person, the last in name order held out.

    Each holds `timestamp_s`, `transl`, `global_orient`, `body_pose` (rotation vectors, world +y up, metres)
    and `betas`, and may hold `left_hand_pose` and `right_hand_pose` (45 numbers or principal coefficients).
    A folder laid out as PROX is read as such. Raises InputError LTM-001 where there is none, LTM-003 and
    LTM-004 where SMPL-X is not there, LTM-005 where PROX is damaged.
    """
    if prox.is_prox(folder):
        return _in_scans(model, folder)
    files = sorted(folder.glob("*.npz"))
    if not files:
        raise InputError(
            "LTM-001", "no SMPL-X motion to learn from", str(folder), "put *.npz and scene.ply there"
        )
    loaded = [
        npz.load(file, ("timestamp_s", "transl", "global_orient", "body_pose", "betas")) for file in files
    ]
    person = smplx_body(model, loaded[0]["betas"])
    moved = [
        motion_from_parameters(person, each["transl"], each["global_orient"], each["body_pose"], _hands(each))
        for each in loaded
    ]
    motions = tuple(
        resample_motion(each["timestamp_s"], motion) for each, motion in zip(loaded, moved, strict=True)
    )
    roots = np.concatenate([motion.world_from_agent[:, :3, 3] for motion in motions])
    scene = MotionScene.for_motion(ply.read_ply(folder / "scene.ply"), roots, reach_m=STUDY_REACH_M)
    dataset = MotionDataset(person.body, motions, (0,) * len(motions), (scene,))
    last = len(motions) - 1
    return DatasetSplit(dataset.subset(list(range(max(last, 1)))), dataset.subset([last]) if last else None)


def _hands(table: dict[str, np.ndarray]) -> np.ndarray | None:
    both = [table[name] for name in ("left_hand_pose", "right_hand_pose") if name in table]
    return np.stack(both, axis=1) if len(both) == 2 else None


def _in_scans(model: Path, folder: Path) -> DatasetSplit:
    """Read PROX, the last recording held out."""
    person, recordings, scenes = prox.read(model, folder)
    names = list(scenes)
    stretches = [(motion, names.index(each.scene)) for each in recordings for motion in each.motions]
    last = sum(len(each.motions) for each in recordings[:-1])
    if not stretches:
        remedy = "give recordings with two seconds of fits without a gap"
        raise InputError(
            "LTM-001", "no two seconds of uninterrupted motion to learn from", str(folder), remedy
        )
    motions, places = zip(*stretches, strict=True)
    dataset = MotionDataset(person.body, motions, places, tuple(scenes.values()))
    held = list(range(last, len(motions))) if 0 < last < len(motions) else []
    train = [index for index in range(len(motions)) if index not in held]
    return DatasetSplit(dataset.subset(train), dataset.subset(held) if held else None)
