"""Several processes that fit one model, each on its own recordings: `torchrun`, or `make <agent>.<artifact>
PROCESSES=4`.

`join` enters the group; alone, everything here is what it is for one process. A shared loss divides by the
number of all processes' elements (`total`), so that a step does not depend on who holds what.
"""

import os
from collections.abc import Callable, Mapping

import torch
from jaxtyping import Float, Shaped
from torch import Tensor, distributed, nn
from torch.nn.parallel import DistributedDataParallel

from pipeline.core import processes

NamedLoss = Callable[[int, torch.Generator], Mapping[str, Float[Tensor, ""]]]
"""of a step and its generator: weighted terms by name"""


def join(device: str) -> None:
    """Enter the group of processes that torchrun started; without torchrun, stay alone. Each takes one GPU,
    if there are any.
    """
    if not distributed.is_torchelastic_launched():
        return
    processes.die_with_parent()
    if device == "cuda":
        torch.cuda.set_device(int(os.environ["LOCAL_RANK"]))  # torchrun's number of this process here
    distributed.init_process_group("nccl" if device == "cuda" else "gloo")


def leave() -> bool:
    """Leave the group; return whether this process is the one that writes what was found."""
    leads = rank() == 0
    if distributed.is_initialized():
        distributed.destroy_process_group()
    return leads


def size() -> int:
    """Return how many processes there are."""
    return distributed.get_world_size() if distributed.is_initialized() else 1


def rank() -> int:
    """Return which of them this is; 0 leads: it alone writes files."""
    return distributed.get_rank() if distributed.is_initialized() else 0


def total(values: Shaped[Tensor, "*any"]) -> Shaped[Tensor, "*any"]:
    """Return the sum over all processes, without gradients."""
    if size() == 1:
        return values.detach()
    there = values.detach().to("cuda" if distributed.get_backend() == "nccl" else "cpu", copy=True)
    distributed.all_reduce(there)
    return there.to(values.device)


def mean(values: Shaped[Tensor, "*any"]) -> Shaped[Tensor, "*any"]:
    """Return the mean over all processes, without gradients: what a shared loss divides by."""
    return total(values) / size()


def share(batch: int) -> int:
    """Return how many of a batch's examples are this process's: each has as many, one at least."""
    return max(batch // size(), 1)


def wait() -> None:
    """Go on when all have come here."""
    if size() > 1:
        distributed.barrier()


class Shared(nn.Module):
    """A loss over modules whose gradients are averaged over all processes as they are computed."""

    def __init__(self, modules: Mapping[str, nn.Module], loss: NamedLoss):
        super().__init__()
        self.learned, self.loss = nn.ModuleDict(modules), loss

    def forward(self, step: int, generator: torch.Generator) -> Mapping[str, Float[Tensor, ""]]:
        """Return the loss's terms."""
        return self.loss(step, generator)


def shared(modules: Mapping[str, nn.Module], loss: NamedLoss) -> NamedLoss:
    """Return a loss whose gradients are the mean of all processes'; all begin with the leader's weights."""
    return DistributedDataParallel(
        Shared(modules, loss), forward_sync_buffers=False, find_unused_parameters=True
    )
