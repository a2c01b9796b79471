"""Several things at once in one process: for work that is mostly spent in libraries, which let others run
meanwhile.
"""

import contextlib
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

import torch

A = TypeVar("A")
B = TypeVar("B")


@contextlib.contextmanager
def alone() -> Iterator[None]:
    """Let torch work with one thread: small steps take longer with two, and sums depend on their number."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def ordered(function: Callable[[A], B], items: Iterable[A], workers: int) -> Iterator[B]:
    """Yield what `function` makes of each item, in their order; at most `workers` are worked on or wait to be
    taken.

    Each is made by one thread, so that sums come out the same however many workers there are. What one raises
    is raised here; those under way are finished first.
    """
    with alone(), ThreadPoolExecutor(workers, initializer=torch.set_num_threads, initargs=(1,)) as pool:
        under_way: deque[Future[B]] = deque()
        try:
            for item in items:
                if len(under_way) == workers:
                    yield under_way.popleft().result()
                under_way.append(pool.submit(function, item))
            while under_way:
                yield under_way.popleft().result()
        finally:
            pool.shutdown(cancel_futures=True)
