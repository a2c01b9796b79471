"""Two processes that share each batch learn what one learns from the whole of it."""

import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from pipeline.core import distributed
from stages.train_localizer import networks
from stages.train_localizer.config import NetworkConfig
from tests import two_processes
from tests.stages.train_localizer.test_kinds import described


def trained(patches: int, views: int) -> list[torch.Tensor]:
    """Return the weights of a coordinate network and of a regressor after four steps."""
    torch.set_num_threads(1)
    sizes = {"coordinate_width": 16, "coordinate_layers": 2, "pose_width": 8}
    config = NetworkConfig(steps=4, batch_patches=patches, batch_views=views, **sizes)
    seen = described(12, 1)
    nets = networks.train_coordinates(seen, config, 0), networks.train_regressor(seen, "scene", config, 0)
    return [torch.cat([value.detach().flatten() for value in net.parameters()]) for net in nets]


def side(rank: int, port: str, folder: Path) -> list[torch.Tensor]:
    """Do what one process of two does, and leave the weights in a file."""
    two_processes.join(rank, port)
    found = trained(128, 8)
    torch.save(found, folder / f"rank{rank}.pt")
    distributed.wait()
    assert distributed.leave() == (rank == 0)
    return found


@pytest.mark.slow
def test_two_processes_learn_what_one_does_from_the_whole_batch(tmp_path, monkeypatch):
    records, fit = [], networks.fit

    def recorded(**given):
        records.append(fit(**given))
        return records[-1]

    monkeypatch.setattr(networks, "fit", recorded)
    with two_processes.started(__name__, tmp_path, monkeypatch) as port:
        together = side(0, port, tmp_path)
    monkeypatch.setattr(networks, "fit", two_processes.fit_both(recorded))
    expected = trained(64, 4)
    for mine, alone in zip(records[:2], records[2:], strict=True):
        np.testing.assert_allclose(mine.total(), alone.total(), rtol=2e-5)
    theirs = torch.load(tmp_path / "rank1.pt", weights_only=True)
    for found, whole, other in zip(together, expected, theirs, strict=True):
        off = (found - whole).abs()  # Adam makes much of gradients that are nearly 0
        assert (off > 2e-5).float().mean() < 1e-2 and off.mean() < 1e-5
        assert torch.equal(found, other), "both hold the same"


if __name__ == "__main__":
    side(1, sys.argv[1], Path(sys.argv[2]))
