"""Opening both sources of motion, with all networks that were trained on each."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.models import ablated_motion, simulated_lives
from pipeline.models.longterm_examples import Cutting, Lives, cut, encoded, reconstructed
from pipeline.models.motion_synthesis import LongTerm
from pipeline.models.trajectories import TRAIN, BehaviorData
from stages.tabulate_longterm.methods import Models


@dataclass(frozen=True)
class Source:
    """Motion that was learned from and motion that was not, and what was learned."""

    train: Lives
    held_out: Lives
    split: tuple[str, ...]
    """per held-out stretch: held_out, unseen or test"""
    models: Models
    data: BehaviorData | None = None


def simulated(world: Path, study: Path) -> Source:
    """Read simulated motion and what was learned from it."""
    lives, split = simulated_lives.load(world)
    learned, rest = np.flatnonzero(np.array(split) == "train"), np.flatnonzero(np.array(split) != "train")
    train = lives.some(learned)
    return Source(train, lives.some(rest), tuple(split[index] for index in rest), _models(study, train))


def recorded(reconstruction: Path, behavior_data: Path, ablations: Path) -> Source:
    """Read reconstructed motion and what was learned from it."""
    data = BehaviorData.load(behavior_data)
    lives, video_of = reconstructed(reconstruction, data)
    learns = {data.videos[video] for video in np.unique(data.video[data.split == TRAIN])}
    train = lives.some([index for index, video in enumerate(video_of) if video in learns])
    rest = [index for index, video in enumerate(video_of) if video not in learns]
    held_out = lives.some(rest) if rest else Lives(lives.body, (), (), lives.scenes)
    return Source(train, held_out, ("test",) * len(rest), _models(ablations, train), data)


def _models(folder: Path, train: Lives) -> Models:
    ours = LongTerm.load(folder)
    ablated = {
        name: ablated_motion.load(folder / "ablations" / f"{name}.safetensors", kind, ours.sizes)
        for name, kind in ablated_motion.KINDS.items()
        if (folder / "ablations" / f"{name}.safetensors").is_file()
    }
    rng = np.random.default_rng(0)
    bank = encoded(train, cut(train, Cutting(resting=0.0), rng), ours.poses, 0, rng)
    return Models(ours, ablated, bank)
