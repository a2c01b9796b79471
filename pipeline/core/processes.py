"""Child processes that cannot outlive their parent. Standard library only."""

import ctypes
import multiprocessing
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from typing import TypeVar

T = TypeVar("T")
_PR_SET_PDEATHSIG = 1


def die_with_parent() -> None:
    """In a child: ask the kernel (Linux) for SIGKILL when the parent dies for any reason."""
    libc = ctypes.CDLL(None)
    if hasattr(libc, "prctl"):
        libc.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)


def unordered(function: Callable[..., T], jobs: Sequence[tuple], workers: int) -> Iterator[tuple[int, T]]:
    """Call `function` with each job's arguments in parallel; yield (index, result) of each.

    Workers are spawned, so that threads and locks are not inherited. They block SIGINT, which a tty sends
    to all processes, from the start; this process kills them when it is interrupted.
    """
    pool = ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), initializer=die_with_parent)
    try:
        # Workers inherit the mask; a signal that arrives meanwhile is delivered afterwards.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            index_of = {pool.submit(function, *job): index for index, job in enumerate(jobs)}
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        for future in as_completed(index_of):
            yield index_of[future], future.result()
    except BaseException:
        for worker in multiprocessing.active_children():
            worker.kill()
        raise
    finally:
        pool.shutdown(cancel_futures=True)
