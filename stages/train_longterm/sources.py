"""Where motion comes from, parted into what is learned from and what is held out."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.errors import InputError
from pipeline.files import arrays, meshes
from pipeline.models import simulated_lives
from pipeline.models.longterm_examples import Lives, reconstructed
from pipeline.models.short_motions import resampled
from pipeline.models.smplx_bodies import motion_from_parameters, smplx_body
from pipeline.models.surroundings import Surroundings
from pipeline.models.trajectories import TRAIN, BehaviorData


@dataclass(frozen=True)
class Parted:
    """Motion to learn from and motion held out; the latter may be nothing."""

    train: Lives
    held_out: Lives | None


def recorded(reconstruction: Path, behavior_data: Path) -> Parted:
    """Read reconstructed sessions, those of the behaviour test held out. Raises LTM-001 where there is too little motion."""
    data = BehaviorData.load(behavior_data)
    lives, video_of = reconstructed(reconstruction, data)
    learns = {data.videos[video] for video in np.unique(data.video[data.split == TRAIN])}
    train = [index for index, video in enumerate(video_of) if video in learns]
    if not train:
        remedy = "record longer sessions in which the animal stays in view"
        raise InputError("LTM-001", "no two seconds of uninterrupted motion to learn from", str(behavior_data), remedy)
    rest = [index for index, video in enumerate(video_of) if video not in learns]
    return Parted(lives.some(train), lives.some(rest) if rest else None)


def simulated(folder: Path) -> Parted:
    """Read simulated motion; homes and sessions that are not for training are held out."""
    lives, split = simulated_lives.load(folder)
    held = np.flatnonzero(np.array(split) != "train")
    return Parted(lives.some(np.flatnonzero(np.array(split) == "train")), lives.some(held) if len(held) else None)


def people(model: Path, folder: Path) -> Parted:
    """Read recorded SMPL-X motion: `scene.ply` and `*.npz` of one person, the last in name order held out.

    Each holds `timestamp_s`, `transl`, `global_orient`, `body_pose` (rotation vectors, world +y up, metres) and `betas`.
    Raises InputError LTM-001 where there is none, LTM-003 and LTM-004 where SMPL-X is not there.
    """
    files = sorted(folder.glob("*.npz"))
    if not files:
        raise InputError("LTM-001", "no SMPL-X motion to learn from", str(folder), "put *.npz and scene.ply there")
    loaded = [arrays.load(file, ("timestamp_s", "transl", "global_orient", "body_pose", "betas")) for file in files]
    person = smplx_body(model, loaded[0]["betas"])
    moved = [motion_from_parameters(person, each["transl"], each["global_orient"], each["body_pose"]) for each in loaded]
    motions = tuple(resampled(each["timestamp_s"], motion) for each, motion in zip(loaded, moved, strict=True))
    roots = np.concatenate([motion.world_from_agent[:, :3, 3] for motion in motions])
    scene = Surroundings.for_motion(meshes.read_ply(folder / "scene.ply"), roots, reach_m=1.5)
    lives = Lives(person.body, motions, (0,) * len(motions), (scene,))
    last = len(motions) - 1
    return Parted(lives.some(list(range(max(last, 1)))), lives.some([last]) if last else None)
