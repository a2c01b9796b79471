"""A source of motion with the networks trained on it."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.baselines import longterm_networks
from pipeline.baselines.longterm_networks import AblatedNetworks
from pipeline.behavior.trajectories import BehaviorData
from pipeline.longterm.clip_channels import Clips
from pipeline.longterm.examples import DatasetSplit, encode_selection, select_clips
from pipeline.longterm.journeys import LongTermWorld
from pipeline.longterm.motion_synthesis import LongTerm


@dataclass(frozen=True)
class MotionSource:
    """Training and held-out motion, and the models trained on it."""

    split: DatasetSplit
    ours: LongTerm
    ablated: dict[str, AblatedNetworks]
    bank: Clips
    """the training clips, without scene points"""
    data: BehaviorData | None = None
    """of reconstructed motion"""

    @property
    def world(self) -> LongTermWorld:
        """The model with the training body and the first training scene."""
        return LongTermWorld(self.ours, self.split.train.body, self.split.train.scenes[0])


def with_models(split: DatasetSplit, folder: Path, data: BehaviorData | None = None) -> MotionSource:
    """Read the models in ``folder``, trained on ``split``; ``data`` only of reconstructed motion."""
    ours = LongTerm.load(folder)
    ablated = {
        name: longterm_networks.load(folder / "ablations" / f"{name}.safetensors", kind, ours.sizes)
        for name, kind in longterm_networks.ABLATIONS.items()
        if (folder / "ablations" / f"{name}.safetensors").is_file()
    }
    rng = np.random.default_rng(0)
    bank = encode_selection(split.train, select_clips(split.train, rng, resting=0.0), ours.poses, 0, rng)
    return MotionSource(split, ours, ablated, bank, data)
