"""Where motion comes from, parted into what is learned from and what is held out."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.errors import InputError
from pipeline.models import simulated_lives
from pipeline.models.longterm_examples import Lives, reconstructed
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
