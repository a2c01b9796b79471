"""Data-parallel training: several processes fit one model, each on its own recordings.

Start them with `torchrun` or `make <agent>.<artifact> PROCESSES=4`; `join` enters the process group. Without
one, everything here works for a single process. A shared loss divides by the number of elements in all
processes (`total`), so that a step does not depend on how data are distributed.
"""

import os
from collections.abc import Callable, Mapping

import torch
from jaxtyping import Float, Shaped
from torch import Tensor, distributed, nn
from torch.nn.parallel import DistributedDataParallel

from pipeline.core import processes

NamedLoss = Callable[[int, torch.Generator], Mapping[str, Float[Tensor, ""]]]
"""maps a step and its random generator to weighted terms by name"""


def join(device: str) -> None:
    """Join the process group that torchrun started, if any, each process with its own GPU if there is one."""
    if not distributed.is_torchelastic_launched():
        return
    processes.die_with_parent()
    if device == "cuda":
        torch.cuda.set_device(int(os.environ["LOCAL_RANK"]))  # local rank on this machine, set by torchrun
    distributed.init_process_group("nccl" if device == "cuda" else "gloo")


def leave() -> bool:
    """Leave the process group; return whether this process has rank 0, which writes results."""
    leads = rank() == 0
    if distributed.is_initialized():
        distributed.destroy_process_group()
    return leads


def size() -> int:
    """Return the number of processes."""
    return distributed.get_world_size() if distributed.is_initialized() else 1


def rank() -> int:
    """Return the rank of this process; only rank 0 writes files."""
    return distributed.get_rank() if distributed.is_initialized() else 0


def total(values: Shaped[Tensor, "*any"]) -> Shaped[Tensor, "*any"]:
    """Return the sum over all processes, without gradients."""
    if size() == 1:
        return values.detach()
    summed = values.detach().to("cuda" if distributed.get_backend() == "nccl" else "cpu", copy=True)
    distributed.all_reduce(summed)
    return summed.to(values.device)


def mean(values: Shaped[Tensor, "*any"]) -> Shaped[Tensor, "*any"]:
    """Return the mean over all processes, without gradients: the divisor of a shared loss."""
    return total(values) / size()


def share(batch: int) -> int:
    """Return the number of a batch's examples per process, at least one."""
    return max(batch // size(), 1)


def wait() -> None:
    """Block until all processes get here (barrier)."""
    if size() > 1:
        distributed.barrier()


class Shared(nn.Module):
    """A loss over modules, wrapped as a module so that DDP averages its gradients over all processes."""

    def __init__(self, modules: Mapping[str, nn.Module], loss: NamedLoss):
        super().__init__()
        self.learned, self.loss = nn.ModuleDict(modules), loss

    def forward(self, step: int, generator: torch.Generator) -> Mapping[str, Float[Tensor, ""]]:
        """Return the loss's terms."""
        return self.loss(step, generator)


def shared(modules: Mapping[str, nn.Module], loss: NamedLoss) -> NamedLoss:
    """Return a loss whose gradients are averaged over all processes; all start with the weights of rank 0."""
    return DistributedDataParallel(
        Shared(modules, loss), forward_sync_buffers=False, find_unused_parameters=True
    )
