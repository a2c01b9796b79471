"""The training loop: seeded steps, checkpoints, resuming, recovery from non-finite losses.

`fit` minimizes a loss with an optimizer and can resume from checkpoints after any kill. Randomness is a pure
function of (seed, step), so that on a CPU an interrupted run is bit-identical to an uninterrupted one.
SIGTERM saves and exits with 75; a loss that stays non-finite exits with 76 and a diagnosis.
"""

import contextlib
import copy
import functools
import json
import math
import os
import signal
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pipeline.core import distributed, progress
from pipeline.core.distributed import NamedLoss

CHECKPOINTS_KEPT = 3
MAX_BROKEN_STEPS = 3
EXIT_SAVED = 75
EXIT_DIVERGED = 76


@dataclass(frozen=True)
class FitRecord:
    """Weighted loss terms of every step; NaN for skipped steps and for terms that the loss did not return."""

    terms: dict[str, Float[np.ndarray, "step"]]
    rolled_back: int
    """number of times that the loop rolled back to a checkpoint and halved the learning rate"""

    def total(self) -> Float[np.ndarray, "step"]:
        """Return the sum of all terms per step."""
        each = np.array(list(self.terms.values()))
        return np.where(np.isnan(each).all(0), np.nan, np.nansum(each, axis=0))


def fit(
    *,
    modules: Mapping[str, torch.nn.Module],
    optimizer: torch.optim.Optimizer,
    loss: NamedLoss,
    steps: int,
    seed: int,
    resume: Path | None = None,
    save_every: int = 500,
    schedule: Callable[[float], float] | None = None,
    label: str = "fit",
    clip_norm: float | None = None,
    after_step: Callable[[int], None] | None = None,
    shared: bool = False,
    asked_to_stop: Callable[[], bool] | None = None,
) -> FitRecord:
    """Minimize ``loss(step, generator)`` for ``steps`` steps, from the newest checkpoint in ``resume`` if
    there is one.

    ``modules`` hold all state to checkpoint (including averaged weights). ``schedule`` maps progress 0..1 to
    a factor on each group's learning rate.
    Steps whose loss or gradient is not finite are skipped; three in a row roll back to the last checkpoint at
    half the rate, and a second rollback ends the run (exit 76, ``diagnosis.json`` in ``resume``).
    ``asked_to_stop`` replaces the signal handlers: several fits in threads share one `termination`.
    With ``shared``, all processes of `pipeline.core.distributed` minimize the mean of their losses; rank 0
    keeps checkpoints.
    """
    shared = shared and distributed.size() > 1
    loop = _Loop(dict(modules), optimizer, resume, shared)
    loop.restore()
    loss = distributed.shared(modules, loss) if shared else loss
    with contextlib.nullcontext(asked_to_stop) if asked_to_stop else termination() as asked_to_stop:
        for _ in progress.track(loop.until(steps), label, total=steps - loop.step):
            if not loop.advance(loss, steps, seed, schedule, clip_norm):
                continue
            if after_step:
                after_step(loop.step - 1)
            stop = asked_to_stop()
            stop = bool(distributed.total(torch.tensor(float(stop)))) if shared else stop
            if resume and (loop.step % save_every == 0 or stop):
                loop.save()
            if stop:
                progress.log(f"{label}: stopped at step {loop.step}" + (", saved" if resume else ""))
                sys.exit(EXIT_SAVED)
    return FitRecord(
        {name: np.asarray(values, np.float32) for name, values in loop.terms.items()}, loop.rolled_back
    )


def generator_for(seed: int, step: int, rank: int = 0) -> torch.Generator:
    """Return the random generator of one step, a pure function of (seed, step, rank)."""
    seeds = np.random.SeedSequence([seed, step, rank] if rank else [seed, step])
    return torch.Generator().manual_seed(int(seeds.generate_state(1, np.uint64)[0] >> np.uint64(1)))


class _Loop:
    """State of a run (modules, optimizer, step, losses so far), which can be saved and restored."""

    def __init__(
        self,
        modules: dict[str, torch.nn.Module],
        optimizer: torch.optim.Optimizer,
        folder: Path | None,
        shared: bool,
    ):
        self.modules, self.optimizer, self.folder, self.shared = modules, optimizer, folder, shared
        self.rank = distributed.rank() if shared else 0
        self.step, self.rate, self.rolled_back, self.broken = 0, 1.0, 0, 0
        self.terms: dict[str, list[float]] = {}
        self.base_rates = [group["lr"] for group in optimizer.param_groups]
        self.start = self._state() if folder is None else None

    def until(self, steps: int) -> Iterator[int]:
        """Yield the next step until all are done; a rollback yields earlier ones again."""
        while self.step < steps:
            yield self.step

    def advance(
        self,
        loss: NamedLoss,
        steps: int,
        seed: int,
        schedule: Callable[[float], float] | None,
        clip_norm: float | None,
    ) -> bool:
        """Do one step. Return False if it was not finite and the loop rolled back to a checkpoint."""
        factor = self.rate * (schedule(self.step / max(steps, 1)) if schedule else 1.0)
        for group, base in zip(self.optimizer.param_groups, self.base_rates, strict=True):
            group["lr"] = base * factor
        generator = generator_for(seed, self.step, self.rank)
        torch.manual_seed(generator.initial_seed())
        terms = loss(self.step, generator)
        self.optimizer.zero_grad(set_to_none=True)
        functools.reduce(torch.add, terms.values()).backward()
        parameters = [
            p for group in self.optimizer.param_groups for p in group["params"] if p.grad is not None
        ]
        norm = torch.nn.utils.clip_grad_norm_(parameters, clip_norm or math.inf)
        values = self._values_of(terms)
        if torch.isfinite(norm) and math.isfinite(sum(values.values())):
            self.optimizer.step()
            self.broken = 0
        else:
            self.broken += 1
            if self.broken >= MAX_BROKEN_STEPS:
                self._roll_back(values, float(norm))
                return False
        for name in self.terms | values:
            self.terms.setdefault(name, [math.nan] * self.step).append(
                values.get(name, math.nan) if self.broken == 0 else math.nan
            )
        self.step += 1
        return True

    def _values_of(self, terms: Mapping[str, Tensor]) -> dict[str, float]:
        """Return the terms as numbers, averaged over all processes."""
        values = torch.stack([value.detach().float() for value in terms.values()])
        values = distributed.total(values) / distributed.size() if self.shared else values
        return dict(zip(terms, values.tolist(), strict=True))

    def _roll_back(self, values: Mapping[str, float], norm: float) -> None:
        diagnosis = {
            "step": self.step,
            "gradient_norm": repr(norm),
            "terms": {name: repr(value) for name, value in values.items()},
        }
        if self.rolled_back >= 1:
            if self.folder and self.rank == 0:
                (self.folder / "diagnosis.json").write_text(json.dumps(diagnosis, indent=2) + "\n")
            progress.log(
                f"the loss is not finite and did not recover at half the rate: {json.dumps(diagnosis)}"
            )
            sys.exit(EXIT_DIVERGED)
        progress.log(
            f"the loss is not finite at step {self.step}: back to the last checkpoint with half the rate"
        )
        if self.start is not None:
            self._load(self.start)
        else:
            self.restore()
        self.rate, self.rolled_back, self.broken = self.rate / 2, self.rolled_back + 1, 0

    def _state(self) -> dict:
        state = {
            "step": self.step,
            "rate": self.rate,
            "rolled_back": self.rolled_back,
            "terms": self.terms,
            "modules": {name: dict(module.state_dict()) for name, module in self.modules.items()},
            "optimizer": self.optimizer.state_dict(),
        }
        return copy.deepcopy(state)  # later steps must not change it

    def _load(self, state: dict) -> None:
        self.step, self.rate, self.rolled_back = state["step"], state["rate"], state["rolled_back"]
        self.terms = {name: list(values) for name, values in state["terms"].items()}
        for name, module in self.modules.items():
            module.load_state_dict(state["modules"][name])
        self.optimizer.load_state_dict(state["optimizer"])

    def save(self) -> None:
        """Write a checkpoint by temporary file, fsync and rename; keep the newest three (rank 0 only)."""
        if self.rank or self.folder is None:
            return
        temp = self.folder / f".step.tmp.{os.getpid()}"
        try:
            with open(temp, "wb") as file:
                torch.save(self._state(), file)
                file.flush()
                os.fsync(file.fileno())
            os.replace(temp, self.folder / f"step{self.step:09d}.pt")
        except BaseException:
            temp.unlink(missing_ok=True)
            raise
        for old in _checkpoints(self.folder)[CHECKPOINTS_KEPT:]:
            old.unlink()

    def restore(self) -> None:
        """Load the newest readable checkpoint, rank 0 first; start over if there is none."""
        if self.folder is None:
            return
        if self.rank == 0:
            self.folder.mkdir(parents=True, exist_ok=True)
            for leftover in self.folder.glob(".step.tmp.*"):
                leftover.unlink()
            self._restore(self.folder)
        if self.shared:
            distributed.wait()
        if self.rank:
            self._restore(self.folder)

    def _restore(self, folder: Path) -> None:
        for path in _checkpoints(folder):
            try:
                state = torch.load(path, weights_only=True, map_location="cpu")
            except Exception as error:  # whatever the damage: try the checkpoint before
                progress.log(f"{path.name} cannot be read ({type(error).__name__}); trying the one before")
                continue
            self._load(state)
            progress.log(f"resumed at step {self.step}")
            return
        self.save()


def _checkpoints(folder: Path) -> list[Path]:
    return sorted(folder.glob("step*.pt"), reverse=True)


@contextlib.contextmanager
def termination() -> Iterator[Callable[[], bool]]:
    """Yield a function that returns whether SIGTERM or SIGINT was received within the block."""
    received = []
    previous = {
        number: signal.signal(number, lambda number, _: received.append(number))
        for number in (signal.SIGTERM, signal.SIGINT)
    }
    try:
        yield lambda: bool(received)
    finally:
        for number, handler in previous.items():
            signal.signal(number, handler)
