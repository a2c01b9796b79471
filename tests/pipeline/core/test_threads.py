"""Work in threads comes back in order, is not begun too early, and its errors are not lost."""

import threading
import time

import pytest
import torch

from pipeline.core.threads import ordered


def test_results_come_in_order_and_few_wait():
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


def test_items_are_asked_for_only_as_results_are_taken():
    asked = []
    found = ordered(lambda number: number, (asked.append(number) or number for number in range(10)), 2)
    next(found)
    assert len(asked) <= 3


def test_errors_are_raised_and_what_waits_is_dropped():
    done = []

    def picky(number: int) -> None:
        if number == 1:
            raise SystemExit(75)
        done.append(number)

    with pytest.raises(SystemExit, match="75"):
        list(ordered(picky, range(100), 2))
    assert len(done) < 5


def test_each_works_with_one_thread_and_ours_are_as_before():
    before = torch.get_num_threads()
    assert set(ordered(lambda _: torch.get_num_threads(), range(4), 2)) == {1}
    assert torch.get_num_threads() == before
