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

STUDY_REACH_M = 1.5
"""heights of the synthetic study's scene that are used, above and below where bodies have been"""


@dataclass(frozen=True)
class DatasetSplit:
    """Motion to learn from and motion held out; the latter may be nothing."""

    train: MotionDataset
    held_out: MotionDataset | None


def recorded(reconstruction: Path, behavior_data: Path) -> DatasetSplit:
    """Read reconstructed sessions, those of the behaviour test held out. Raises LTM-001 where there is too
    little motion.
    """
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
    and `betas`. Raises InputError LTM-001 where there is none, LTM-003 and LTM-004 where SMPL-X is not there.
    """
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
        motion_from_parameters(person, each["transl"], each["global_orient"], each["body_pose"])
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
