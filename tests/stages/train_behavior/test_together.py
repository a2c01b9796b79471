"""Two processes with half batches train like one with the full batch."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from pipeline.behavior.diffusion import Schedule
from pipeline.behavior.scenes import Scenes
from pipeline.core.training import generator_for
from pipeline.environments.homes import Habitat
from stages.train_behavior import baseline_losses, objective, training
from stages.train_behavior.config import BehaviorOptimizerConfig, BehaviorTrainingConfig
from tests import two_processes
from tests.pipeline.behavior.wandering import ARCHITECTURE, room, wandering

FAMILIES = ("diffusion", "gaussian", "one_stage")


def trained(family: str, batch: int, folder: Path | None = None) -> training.TrainedBehavior:
    """Train for six steps, half of them on goals; a quarter of the windows are mirrored without bones."""
    pace = BehaviorOptimizerConfig(steps=6, goal_steps=3, batch=batch, goal_batch=batch, rate=1e-3)
    return training.train(
        Habitat.of_one_home(wandering(), Scenes.of(room())),
        replace(ARCHITECTURE, family=family),
        Schedule(),
        BehaviorTrainingConfig(pace),
        seed=3,
        resume=folder,
    )


def weights(found: training.TrainedBehavior) -> torch.Tensor:
    return torch.cat([value.detach().flatten() for value in found.nets.parameters()])


def side(rank: int, port: str, folder: Path) -> list[training.TrainedBehavior]:
    """Run one of two processes and save its weights."""
    two_processes.join(rank, port)
    found = [trained(family, 16, folder / family) for family in FAMILIES]
    two_processes.leave(rank, folder, [weights(each) for each in found])
    return found


class BothRows:
    """Replacement of `distributed` in a process that computes the losses of two: rows are counted over both."""

    def __init__(self) -> None:
        self.counted: list[torch.Tensor] = []
        self.count: torch.Tensor | None = None

    def mean(self, values: torch.Tensor) -> torch.Tensor:
        self.counted.append(values)
        return values if self.count is None else self.count

    def size(self) -> int:
        return 2


def alone(family: str, monkeypatch: pytest.MonkeyPatch) -> training.TrainedBehavior:
    """Train in one process on the half batches of both."""
    fit, rows = training.fit, BothRows()
    monkeypatch.setattr(objective, "distributed", rows)
    monkeypatch.setattr(baseline_losses, "distributed", rows)

    def fit_both(*, loss, **rest):
        def of_both(step: int, _: torch.Generator) -> dict[str, torch.Tensor]:
            for known in (False, True):
                rows.count = torch.stack(rows.counted).mean() if known and rows.counted else None
                rows.counted, parts = [], []
                for rank in range(2):
                    generator = generator_for(3, step, rank)
                    torch.manual_seed(generator.initial_seed())
                    parts.append(loss(step, generator))
            return {name: (parts[0][name] + parts[1][name]) / 2 for name in parts[0]}

        return fit(loss=of_both, **rest)

    with monkeypatch.context() as patched:
        patched.setattr(training, "fit", fit_both)
        return trained(family, 8)


@pytest.mark.slow
def test_two_processes_agree_with_one_on_the_full_batch(tmp_path, monkeypatch):
    with two_processes.started(__name__, tmp_path, monkeypatch) as port:
        together = side(0, port, tmp_path)
    theirs = torch.load(tmp_path / "rank1.pt", weights_only=True)
    for family, found, other in zip(FAMILIES, together, theirs, strict=True):
        expected = alone(family, monkeypatch)
        np.testing.assert_allclose(found.record.total(), expected.record.total(), rtol=1e-5, err_msg=family)
        off = (weights(found) - weights(expected)).abs()  # Adam amplifies gradients that are nearly 0
        assert (off > 2e-5).float().mean() < 1e-3 and off.mean() < 1e-6, family
        assert torch.equal(weights(found), other), "both hold the same"
        assert list((tmp_path / family).glob("step*6.pt")), "the first keeps checkpoints"


if __name__ == "__main__":
    side(1, sys.argv[1], Path(sys.argv[2]))
