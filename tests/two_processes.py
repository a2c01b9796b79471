"""Distributed tests with two processes on the loopback interface, configured as by torchrun."""

import contextlib
import os
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import torch

from pipeline.core import distributed
from pipeline.core.distributed import NamedLoss
from pipeline.core.training import FitRecord, generator_for

TORCHRUN = ("RANK", "LOCAL_RANK", "WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT", "TORCHELASTIC_RUN_ID")


def join(rank: int, port: str) -> None:
    """Join the process group of two with the environment of torchrun."""
    torch.set_num_threads(1)
    os.environ.update(zip(TORCHRUN, (str(rank), str(rank), "2", "127.0.0.1", port, "test"), strict=True))
    distributed.join("cpu")


def leave(rank: int, folder: Path, result: torch.Tensor | list[torch.Tensor]) -> None:
    """Save what a process found as ``rank<rank>.pt`` in ``folder``, and leave the group with the other one."""
    torch.save(result, folder / f"rank{rank}.pt")
    distributed.wait()
    assert distributed.leave() == (rank == 0)


@contextlib.contextmanager
def started(module: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """Run ``module`` with a port and ``folder`` as the second process; yield the port."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = str(probe.getsockname()[1])
    for name in TORCHRUN:
        monkeypatch.setenv(name, "")
    other = subprocess.Popen([sys.executable, "-m", module, port, str(folder)])
    try:
        yield port
        assert other.wait(60) == 0
    finally:
        other.kill()


def fit_both(fit: Callable[..., FitRecord]) -> Callable[..., FitRecord]:
    """Return a `training.fit` for one process that averages the losses of the batches of both."""

    def fit_mean(*, loss: NamedLoss, seed: int, **rest: Any) -> FitRecord:
        def mean_loss(step: int, _: torch.Generator) -> dict[str, torch.Tensor]:
            parts = []
            for rank in range(2):
                generator = generator_for(seed, step, rank)
                torch.manual_seed(generator.initial_seed())
                parts.append(loss(step, generator))
            names = dict.fromkeys([*parts[0], *parts[1]])
            return {name: sum(part.get(name, torch.zeros(())) for part in parts) / 2 for name in names}

        return fit(loss=mean_loss, seed=seed, **rest)

    return fit_mean
