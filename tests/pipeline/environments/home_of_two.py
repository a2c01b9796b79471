"""A home of a cat and a dog with untrained networks that attend to each other, for tests."""

from pathlib import Path

import torch

from pipeline.behavior.model import BehaviorNets
from tests.pipeline.behavior.wandering import ARCHITECTURE
from tests.pipeline.environments.small_world import write_build


def write_animals(folder: Path) -> None:
    """Write two animals recorded in the same sessions in one room, each into a folder of its name."""
    for seed, name in enumerate(("cat", "dog")):
        torch.manual_seed(seed)
        nets = BehaviorNets(ARCHITECTURE)
        attentive = [parameter for member in nets.perception for parameter in member.others.parameters()]
        for parameter in (*attentive, *nets.goal.parameters()):
            torch.nn.init.normal_(parameter, std=0.3)
        write_build(folder / name, seed, nets)
        for artifact in ("behavior_data", "behavior"):
            (folder / name / artifact / "manifest.json").write_text("{}")
