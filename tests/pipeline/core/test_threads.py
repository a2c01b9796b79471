"""Results of threads arrive in order, with bounded look-ahead, and errors are raised."""

import threading
import time

import pytest
import torch

from pipeline.core.threads import ordered


def test_results_are_ordered_and_buffering_is_bounded():
    lock, busy, most = threading.Lock(), 0, 0

    def slow(number: int) -> int:
        nonlocal busy, most
        with lock:
            busy, most = busy + 1, max(most, busy + 1)
        time.sleep(0.002 * (5 - number % 5))
        with lock:
            busy -= 1
        return number

    assert list(ordered(slow, range(12), 3)) == list(range(12))
    assert 1 < most <= 3


def test_items_are_consumed_lazily():
    asked = []
    found = ordered(lambda number: number, (asked.append(number) or number for number in range(10)), 2)
    next(found)
    assert len(asked) <= 3


def test_errors_are_raised_and_pending_items_dropped():
    done = []

    def failing(number: int) -> None:
        if number == 1:
            raise SystemExit(75)
        done.append(number)

    with pytest.raises(SystemExit, match="75"):
        list(ordered(failing, range(100), 2))
    assert len(done) < 5


def test_workers_use_one_thread_and_settings_are_restored():
    before = torch.get_num_threads()
    assert set(ordered(lambda _: torch.get_num_threads(), range(4), 2)) == {1}
    assert torch.get_num_threads() == before
