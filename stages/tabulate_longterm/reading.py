"""Opening both sources of motion, with all networks that were trained on each."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.behavior.trajectories import TRAIN, BehaviorData
from pipeline.longterm import simulated_lives
from pipeline.longterm.examples import MotionDataset, encode_selection, reconstructed_dataset, select_clips
from pipeline.longterm.motion_synthesis import LongTerm
from pipeline.rivals import longterm_networks
from stages.tabulate_longterm.methods import ComparedModels


@dataclass(frozen=True)
class MotionSource:
    """Motion that was learned from and motion that was not, and what was learned."""

    train: MotionDataset
    held_out: MotionDataset
    split: tuple[str, ...]
    """per held-out stretch: held_out, unseen or test"""
    models: ComparedModels
    data: BehaviorData | None = None


def simulated(world: Path, study: Path) -> MotionSource:
    """Read simulated motion and what was learned from it."""
    dataset, split = simulated_lives.load(world)
    learned, rest = np.flatnonzero(np.array(split) == "train"), np.flatnonzero(np.array(split) != "train")
    train = dataset.subset(learned)
    return MotionSource(
        train, dataset.subset(rest), tuple(split[index] for index in rest), _models(study, train)
    )


def recorded(reconstruction: Path, behavior_data: Path, ablations: Path) -> MotionSource:
    """Read reconstructed motion and what was learned from it."""
    data = BehaviorData.load(behavior_data)
    dataset, video_of = reconstructed_dataset(reconstruction, data)
    learns = {data.videos[video] for video in np.unique(data.video[data.split == TRAIN])}
    train = dataset.subset([index for index, video in enumerate(video_of) if video in learns])
    rest = [index for index, video in enumerate(video_of) if video not in learns]
    held_out = dataset.subset(rest) if rest else MotionDataset(dataset.body, (), (), dataset.scenes)
    return MotionSource(train, held_out, ("test",) * len(rest), _models(ablations, train), data)


def _models(folder: Path, train: MotionDataset) -> ComparedModels:
    ours = LongTerm.load(folder)
    ablated = {
        name: longterm_networks.load(folder / "ablations" / f"{name}.safetensors", kind, ours.sizes)
        for name, kind in longterm_networks.ABLATIONS.items()
        if (folder / "ablations" / f"{name}.safetensors").is_file()
    }
    rng = np.random.default_rng(0)
    bank = encode_selection(train, select_clips(train, rng, resting=0.0), ours.poses, 0, rng)
    return ComparedModels(ours, ablated, bank)
