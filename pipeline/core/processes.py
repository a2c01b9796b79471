"""Child processes that cannot outlive what they work for. Standard library only."""

import ctypes
import multiprocessing
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from typing import TypeVar

T = TypeVar("T")
_PR_SET_PDEATHSIG = 1


def die_with_parent() -> None:
    """In a child: ask the kernel for SIGKILL when the parent dies, however it dies (on Linux)."""
    libc = ctypes.CDLL(None)
    if hasattr(libc, "prctl"):
        libc.prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)


def unordered(function: Callable[..., T], jobs: Sequence[tuple], workers: int) -> Iterator[tuple[int, T]]:
    """Call `function` with the arguments of every job, several at once; yield each job's number and result
    when it is done.

    The workers are fresh interpreters: threads and locks are not inherited. Ctrl-C reaches every process of a
    terminal; they leave it to this one, from their first instruction on, and are ended when it stops asking.
    """
    pool = ProcessPoolExecutor(workers, multiprocessing.get_context("spawn"), initializer=die_with_parent)
    try:
        # Inherited; what comes meanwhile comes afterwards.
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            number = {pool.submit(function, *job): index for index, job in enumerate(jobs)}
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)
        for future in as_completed(number):
            yield number[future], future.result()
    except BaseException:
        for worker in multiprocessing.active_children():
            worker.kill()
        raise
    finally:
        pool.shutdown(cancel_futures=True)
