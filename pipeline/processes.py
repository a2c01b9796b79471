"""Child processes that cannot outlive what they work for. Standard library only."""

import ctypes
import multiprocessing
import signal
from concurrent.futures import ProcessPoolExecutor

_PR_SET_PDEATHSIG = 1


def die_with_parent() -> None:
    """In a child: ask the kernel for SIGKILL when the parent dies, however it dies (Linux; elsewhere nothing)."""
    libc = ctypes.CDLL(None)
    if hasattr(libc, "prctl"):
        libc.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)


def pool(workers: int) -> ProcessPoolExecutor:
    """Return a pool of fresh interpreters (threads and locks are not inherited) that die with this process."""
    return ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), initializer=die_with_parent)
