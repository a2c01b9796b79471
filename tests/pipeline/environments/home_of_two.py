"""A home of a cat and a dog with untrained networks that attend to each other, for tests."""

from pathlib import Path

import numpy as np
import torch

from pipeline.behavior.diffusion import Schedule
from pipeline.behavior.model import BehaviorNets
from pipeline.data import npz
from stages.train_behavior.export import write_contract
from tests.pipeline.behavior.wandering import ARCHITECTURE, REST, room, scaling, wandering


def write_animals(folder: Path) -> None:
    """Write two animals recorded in the same sessions in one room, each into a folder of its name."""
    volume = room()
    for seed, name in enumerate(("cat", "dog")):
        for artifact in ("behavior_data", "behavior"):
            (folder / name / artifact).mkdir(parents=True)
            (folder / name / artifact / "manifest.json").write_text("{}")
        wandering(seed).save(folder / name / "behavior_data")
        known = {"allowed": (volume.occupancy == 0).astype(np.uint8), "stands_m": np.full((2, 2), np.nan)}
        npz.save(folder / name / "behavior_data/volume.npz", **vars(volume), **known)
        torch.manual_seed(seed)
        nets = BehaviorNets(ARCHITECTURE)
        attentive = [parameter for member in nets.perception for parameter in member.others.parameters()]
        for parameter in (*attentive, *nets.goal.parameters()):
            torch.nn.init.normal_(parameter, std=0.3)
        write_contract(folder / name / "behavior", nets, ARCHITECTURE, scaling(), Schedule(), REST)
