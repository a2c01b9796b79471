"""A test and a second process of its own module, which meet on the loopback interface as torchrun's do."""

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
from pipeline.core.training import FitRecord, Loss, generator_for

TORCHRUN = ("RANK", "LOCAL_RANK", "WORLD_SIZE", "MASTER_ADDR", "MASTER_PORT", "TORCHELASTIC_RUN_ID")


def join(rank: int, port: str) -> None:
    """Enter the group of two as torchrun would start this process."""
    torch.set_num_threads(1)
    os.environ.update(zip(TORCHRUN, (str(rank), str(rank), "2", "127.0.0.1", port, "test"), strict=True))
    distributed.join("cpu")


@contextlib.contextmanager
def started(module: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """Run ``module`` with a port and ``folder`` as the second process; yield the port."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    for name in TORCHRUN:
        monkeypatch.setenv(name, "")
    other = subprocess.Popen([sys.executable, "-m", module, port, str(folder)])
    try:
        yield port
        assert other.wait(60) == 0
    finally:
        other.kill()


def fit_both(fit: Callable[..., FitRecord]) -> Callable[..., FitRecord]:
    """Return `training.fit` in one process on what two would draw: the mean of their losses."""

    def fitted(*, loss: Loss, seed: int, **rest: Any) -> FitRecord:
        def of_both(step: int, _: torch.Generator) -> dict[str, torch.Tensor]:
            parts = []
            for rank in range(2):
                generator = generator_for(seed, step, rank)
                torch.manual_seed(generator.initial_seed())
                terms = loss(step, generator)
                parts.append({"loss": terms} if isinstance(terms, torch.Tensor) else terms)
            names = dict.fromkeys([*parts[0], *parts[1]])
            return {name: sum(part.get(name, torch.zeros(())) for part in parts) / 2 for name in names}

        return fit(loss=of_both, seed=seed, **rest)

    return fitted
