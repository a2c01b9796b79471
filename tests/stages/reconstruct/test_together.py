"""Two processes that share the videos give the gradients of one with the same batch, and complete all phases."""

import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from pipeline.core import training
from pipeline.core.errors import InputError
from stages.reconstruct import losses, optimize
from stages.reconstruct.config import LossWeights
from stages.reconstruct.joint import JointLoss
from stages.reconstruct.problem import Problem
from tests import two_processes
from tests.stages.reconstruct.test_optimize import UPRIGHT, WIDE, film, plan, problem

STEPS = 3


def three_videos() -> Problem:
    rng = np.random.default_rng(0)
    return problem(
        videos=[
            film("v002", 9, True, rng, WIDE),
            film("v003", 7, True, rng, WIDE),
            film("v001", 6, False, rng, UPRIGHT),
        ]
    )[0]


def loss_of(found: Problem, rank: int) -> JointLoss:
    return JointLoss(found.share(rank, 2), LossWeights(), plan().batches.share(2), STEPS)


def learned(found: Problem) -> torch.Tensor:
    return torch.cat(
        [value.detach().flatten() for module in found.modules().values() for value in module.parameters()]
    )


def fitted(found: Problem, loss, shared: bool) -> tuple[torch.Tensor, np.ndarray]:
    parameters = [value for module in found.modules().values() for value in module.parameters()]
    optimizer = torch.optim.SGD(parameters, lr=1e-3)
    record = training.fit(
        modules=found.modules(), optimizer=optimizer, loss=loss, steps=STEPS, seed=0, shared=shared
    )
    return learned(found), record.total()


def side(rank: int, port: str, folder: Path) -> tuple[torch.Tensor, torch.Tensor, np.ndarray]:
    """Run one of two processes: the same steps, then a whole run whose weights are saved."""
    two_processes.join(rank, port)
    found, whole = three_videos(), three_videos()
    weights, total = fitted(found, loss_of(found, rank), shared=True)
    optimize.optimize(whole, plan(folder / "resume", template=2, scene=3, body=2, joint=3, save_every=2))
    two_processes.leave(rank, folder, learned(whole))
    return learned(whole), weights, total


@pytest.mark.slow
def test_two_processes_agree_with_one_on_the_same_batch(tmp_path, monkeypatch):
    with two_processes.started(__name__, tmp_path, monkeypatch) as port:
        whole, weights, total = side(0, port, tmp_path)
    alone = three_videos()
    shares, weighted = [loss_of(alone, rank) for rank in range(2)], losses.weighted

    def of_both(step: int, _: torch.Generator) -> dict[str, torch.Tensor]:
        parts = []
        monkeypatch.setattr(losses, "weighted", lambda terms, shared: parts.append(terms))
        for rank, loss in enumerate(shares):
            loss(step, training.generator_for(0, step, rank))
        return weighted(
            {
                name: (weight, torch.cat([part[name][1].flatten() for part in parts]))
                for name, (weight, _) in parts[0].items()
            }
        )

    expected, expected_total = fitted(alone, of_both, shared=False)
    np.testing.assert_allclose(total, expected_total, rtol=1e-5)
    torch.testing.assert_close(weights, expected, rtol=1e-4, atol=1e-6)
    assert (weights - learned(three_videos())).abs().max() > 1e-4, "something was learned"
    assert torch.equal(whole, torch.load(tmp_path / "rank1.pt", weights_only=True)), "both hold the same"
    assert sorted(path.parent.name for path in (tmp_path / "resume").glob("*/step*2.pt")).count("scene") == 1


def test_videos_are_not_split_between_processes():
    found = three_videos()
    shares = [found.share(rank, 2) for rank in range(2)]
    for kind in ("scene", "agent"):
        videos = [set(found.video[getattr(share.store, kind).frame].tolist()) for share in shares]
        assert not videos[0] & videos[1] and videos[0] | videos[1] == set(
            found.video[getattr(found.store, kind).frame].tolist()
        )
    assert sum(len(share.agent_frames) for share in shares) == len(found.agent_frames)
    with pytest.raises(InputError, match="RCN-002"):
        found.share(0, 3)


if __name__ == "__main__":
    side(1, sys.argv[1], Path(sys.argv[2]))
