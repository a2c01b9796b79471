"""Two processes with half batches train like one with the full batch."""

import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from pipeline.longterm.config import LongTermOptimizerConfig
from stages.train_longterm import learning, training
from stages.train_longterm.config import Config
from tests import two_processes
from tests.pipeline.longterm import strider
from tests.stages.train_longterm.test_training import SIZES

NETWORKS = ("static", "route", "pose")


def trained(batch: int) -> learning.TrainedLongTerm:
    """Train for four steps on the 4 clips and 50 bodies of the data."""
    short = LongTermOptimizerConfig(epochs=4 * batch / 4, batch=batch)
    body = LongTermOptimizerConfig(epochs=4 * batch / 50, batch=batch)
    config = Config(body=body, route=short, pose=short, clip_stride=40, max_bodies=60)
    return learning.train_networks(strider.dataset(count=2, seconds=4.0), config, sizes=SIZES)


def weights(found: learning.TrainedLongTerm) -> torch.Tensor:
    nets = [getattr(found.model, name) for name in NETWORKS]
    return torch.cat([value.detach().flatten() for net in nets for value in net.parameters()])


def side(rank: int, port: str, folder: Path) -> learning.TrainedLongTerm:
    """Run one of two processes and save its weights."""
    two_processes.join(rank, port)
    found = trained(16)
    two_processes.leave(rank, folder, weights(found))
    return found


def alone(monkeypatch: pytest.MonkeyPatch) -> learning.TrainedLongTerm:
    """Train in one process on the half batches of both."""
    monkeypatch.setattr(training, "fit", two_processes.fit_both(training.fit))
    return trained(8)


@pytest.mark.slow
def test_two_processes_agree_with_one_on_the_full_batch(tmp_path, monkeypatch):
    with two_processes.started(__name__, tmp_path, monkeypatch) as port:
        together = side(0, port, tmp_path)
    expected = alone(monkeypatch)
    for name in NETWORKS:
        losses = (found.records[name].total() for found in (together, expected))
        np.testing.assert_allclose(*losses, rtol=2e-5, err_msg=name)
    off = (weights(together) - weights(expected)).abs()  # Adam amplifies gradients that are nearly 0
    assert (off > 2e-5).float().mean() < 1e-2 and off.mean() < 1e-5
    assert torch.equal(weights(together), torch.load(tmp_path / "rank1.pt", weights_only=True))


if __name__ == "__main__":
    side(1, sys.argv[1], Path(sys.argv[2]))
