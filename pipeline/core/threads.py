"""Thread pools for work in libraries that release the GIL."""

import contextlib
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

import torch

A = TypeVar("A")
B = TypeVar("B")


@contextlib.contextmanager
def single_threaded() -> Iterator[None]:
    """Limit torch to one thread: small steps are slower with two, and sums depend on their number."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def ordered(function: Callable[[A], B], items: Iterable[A], workers: int) -> Iterator[B]:
    """Map `function` over `items` in parallel, in order; at most `workers` results are pending.

    Each result is computed by one thread, so sums do not depend on the number of workers. An exception is
    raised here after running calls have finished.
    """
    pool = ThreadPoolExecutor(workers, initializer=torch.set_num_threads, initargs=(1,))
    with single_threaded(), pool:
        pending: deque[Future[B]] = deque()
        try:
            for item in items:
                if len(pending) == workers:
                    yield pending.popleft().result()
                pending.append(pool.submit(function, item))
            while pending:
                yield pending.popleft().result()
        finally:
            pool.shutdown(cancel_futures=True)
