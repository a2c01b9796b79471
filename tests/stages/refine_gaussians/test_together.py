"""Two processes that render one frame each agree with one that renders both."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from pipeline.core.training import FitRecord
from pipeline.fields.gaussians import Splats
from stages.refine_gaussians import refine
from stages.refine_gaussians.config import GaussianWeights
from stages.refine_gaussians.refine import FrameLoss, MotionDeltas
from tests import two_processes
from tests.stages.refine_gaussians.test_device import session
from tests.stages.refine_gaussians.test_splats import ball

STEPS = 4


def refined(steps: int) -> tuple[FitRecord, torch.Tensor]:
    """Refine a room and an animal; the last frame has no flow."""
    torch.manual_seed(0)
    splats = Splats(ball(0.5, 60), ball(0.2, 60), torch.ones(60, 1), torch.eye(4)[None], videos=1)
    deltas, sequence = MotionDeltas(4, 1), session()
    loss = FrameLoss(splats, deltas, [replace(sequence)], GaussianWeights(), 32, "tiles")
    record = refine.refine(loss, steps, 0, None, 2)
    return record, torch.cat([v.detach().flatten() for m in (splats, deltas) for v in m.parameters()])


def side(rank: int, port: str, folder: Path) -> tuple[FitRecord, torch.Tensor]:
    """Run one of two processes and save its result."""
    two_processes.join(rank, port)
    record, found = refined(2 * STEPS)
    two_processes.leave(rank, folder, found)
    return record, found


@pytest.mark.slow
def test_two_processes_agree_with_one(tmp_path, monkeypatch):
    with two_processes.started(__name__, tmp_path, monkeypatch) as port:
        record, found = side(0, port, tmp_path)
    assert len(record.total()) == STEPS, "each process draws half of the frames"
    monkeypatch.setattr(refine, "fit", two_processes.fit_both(refine.fit))
    expected, alone = refined(STEPS)
    np.testing.assert_allclose(record.total(), expected.total(), rtol=1e-4)
    off = (found - alone).abs()
    assert (off > 1e-4).float().mean() < 1e-2 and off.mean() < 1e-5
    assert torch.equal(found, torch.load(tmp_path / "rank1.pt", weights_only=True)), "both hold the same"


if __name__ == "__main__":
    side(1, sys.argv[1], Path(sys.argv[2]))
