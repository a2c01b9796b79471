"""Progress on standard error: a bar on a terminal, a line every 10 s elsewhere."""

import sys
import time
from collections.abc import Iterable, Iterator, Sized
from typing import TypeVar

from pipeline.core.errors import printable

T = TypeVar("T")

LINE_EVERY_S = 10.0
BAR_EVERY_S = 0.2
BAR_WIDTH = 28


def log(message: str) -> None:
    """Print one message to standard error."""
    print(printable(message), file=sys.stderr, flush=True)


def track(iterable: Iterable[T], label: str, total: int | None = None) -> Iterator[T]:
    """Yield from `iterable` and report progress; give `total` if it has no length."""
    if total is None and isinstance(iterable, Sized):
        total = len(iterable)
    on_terminal = sys.stderr.isatty()
    pause = BAR_EVERY_S if on_terminal else LINE_EVERY_S
    start = reported = time.monotonic()
    done = 0
    for item in iterable:
        yield item
        done += 1
        now = time.monotonic()
        if now - reported >= pause:
            reported = now
            _report(label, done, total, now - start, on_terminal)
    if on_terminal and reported > start:
        _report(label, done, total, time.monotonic() - start, on_terminal)
        print(file=sys.stderr)


def _report(label: str, done: int, total: int | None, seconds: float, on_terminal: bool) -> None:
    if total:
        left_s = seconds / done * (total - done)
        text = f"{label} {done}/{total} ({100 * done // total} %), {left_s:.0f} s left"
    else:
        text = f"{label} {done}, {seconds:.0f} s"
    if on_terminal:
        filled = BAR_WIDTH * done // total if total else 0
        bar = "█" * filled + "·" * (BAR_WIDTH - filled)
        print(f"\r\x1b[K{bar} {text}", end="", file=sys.stderr, flush=True)
    else:
        log(text)
