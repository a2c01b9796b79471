"""The error type for mistakes that a user can fix.

Any other failure is a bug of ours and shows as an `assert` or a plain traceback. Standard library only.
"""

import argparse
import contextlib
import errno
import os
import re
import signal
import sys
from collections.abc import Callable, Iterator
from typing import Any, NoReturn

_DISK_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
"""No space left, quota exceeded, or the shell's file size limit (`ulimit -f`)."""
_RUST_ERRNO = re.compile(r"\(os error (\d+)\)")
"""Error number in messages of safetensors, which is written in Rust."""
QUOTED = 120
"""Maximum number of characters of a library's message in an error."""
MAKE_AGAIN = "build it again with this version: make <agent>.<artifact>.redo"
"""Remedy for files that another version wrote."""


class InputError(Exception):
    """A user's input is wrong: says what, where, and one thing to do; `code` is stable (`CAP-003`)."""

    def __init__(self, code: str, what: str, where: str = "", remedy: str = "") -> None:
        super().__init__(code, what, where, remedy)
        self.code, self.what, self.where, self.remedy = code, what, where, remedy

    def __str__(self) -> str:
        place = f"{printable(self.where)}: ".replace("\n", "\\n") if self.where else ""
        advice = f"\n  -> {self.remedy}" if self.remedy else ""
        return printable(f"{self.code} {place}{self.what}{advice}")


class CommandLine(argparse.ArgumentParser):
    """Raises RUN-004 for invalid arguments, where argparse prints its usage; help keeps its line breaks."""

    def __init__(self, description: str | None, **settings: Any) -> None:
        layout = argparse.RawDescriptionHelpFormatter
        super().__init__(description=description, formatter_class=layout, **settings)

    def error(self, message: str) -> NoReturn:
        raise InputError("RUN-004", message, self.prog, "see --help")


def printable(text: str) -> str:
    """Escape control characters: file names may contain ESC sequences, which terminals would execute."""
    return "".join(c if c.isprintable() or c == "\n" else c.encode("unicode_escape").decode() for c in text)


@contextlib.contextmanager
def coded_disk_errors(where: str) -> Iterator[None]:
    """Turn a disk error that the user can fix into an `InputError`: SYS-001 (full), SYS-003 (no access)."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        cause = _os_error(error)
        if cause is None:
            raise
        place = str(cause.filename or where)
        if cause.errno in _DISK_FULL:
            remedy = "free some space and run the same again"
            raise InputError("SYS-001", "the disk is full", place, remedy) from error
        if cause.errno in (errno.EROFS, errno.EACCES, errno.EPERM):
            remedy = "look at who owns it and whether the disk is mounted read-only, then run the same again"
            raise InputError("SYS-003", f"cannot be used: {cause.strerror}", place, remedy) from error
        raise


def exit_code(program: Callable[[], int], where: str = "build") -> int:
    """Run a program and return its exit code: 2 after an `InputError`, which is printed, 130 after Ctrl-C."""
    try:
        with coded_disk_errors(where):
            return program()
    except InputError as error:
        print(f"error: {error}", file=sys.stderr, flush=True)
        return 2
    except KeyboardInterrupt:
        return 128 + signal.SIGINT


@contextlib.contextmanager
def other_versions_refused(what: str, where: str) -> Iterator[None]:
    """Turn any exception from reading a `what` (`behavior model`) of another version into ART-007."""
    try:
        yield
    except (InputError, PermissionError):
        raise
    except Exception as error:  # exceptions of parsers have no common base class
        reason = f"{type(error).__name__}: {' '.join(str(error).split())[:QUOTED]}"
        found = f"is no {what} as this version writes it ({reason})"
        raise InputError("ART-007", found, where, MAKE_AGAIN) from error


def _os_error(error: Exception) -> OSError | None:
    """Return the `OSError` behind an exception: torch wraps it, safetensors quotes it in its message."""
    if isinstance(error, OSError):
        return error
    cause = error.__context__
    if isinstance(error, RuntimeError) and isinstance(cause, OSError) and cause.errno in _DISK_FULL:
        return cause
    number = _RUST_ERRNO.search(str(error))
    return OSError(int(number[1]), os.strerror(int(number[1]))) if number else None
