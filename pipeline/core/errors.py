"""The one error that a user can cause and therefore can repair.

Everything else that goes wrong is a broken promise of ours: an `assert` or a plain traceback. Standard
library only.
"""

import contextlib
import errno
import os
import re
import signal
import sys
from collections.abc import Callable, Iterator

_FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
"""No space, a quota, or a limit of the shell (`ulimit -f`)."""
_OF_RUST = re.compile(r"\(os error (\d+)\)")
"""How safetensors' messages name the system's error."""
QUOTED = 120
"""Characters of a library's message that an error shows."""
MAKE_AGAIN = "build it again with this version: make <agent>.<artifact>.redo"
"""What to do about what another version wrote."""


class InputError(Exception):
    """Something handed to a program is wrong: say what, where, and one thing to do about it.

    `code` is stable (`CAP-003`), so that it can be searched for and tested.
    """

    def __init__(self, code: str, what: str, where: str = "", remedy: str = "") -> None:
        super().__init__(code, what, where, remedy)
        self.code, self.what, self.where, self.remedy = code, what, where, remedy

    def __str__(self) -> str:
        place = f"{printable(self.where)}: ".replace("\n", "\\n") if self.where else ""
        advice = f"\n  -> {self.remedy}" if self.remedy else ""
        return printable(f"{self.code} {place}{self.what}{advice}")


def printable(text: str) -> str:
    """Return text whose control characters are spelled out: names of files may hold ESC, terminals obey."""
    return "".join(c if c.isprintable() or c == "\n" else c.encode("unicode_escape").decode() for c in text)


@contextlib.contextmanager
def coded_disk_errors(where: str) -> Iterator[None]:
    """Turn an error that the user can cure into an `InputError`: SYS-001 (full), SYS-003 (forbidden)."""
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        cause = _of_the_system(error)
        if cause is None:
            raise
        place = str(cause.filename or where)
        if cause.errno in _FULL:
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
    """Turn what reading a file of another version raises into an `InputError` ART-007.

    ``what`` is expected (`behavior model`), at ``where``: by hand any artifact may be given.
    """
    try:
        yield
    except (InputError, PermissionError):
        raise
    except Exception as error:  # a parser's own errors have no common base
        reason = f"{type(error).__name__}: {' '.join(str(error).split())[:QUOTED]}"
        found = f"is no {what} as this version writes it ({reason})"
        raise InputError("ART-007", found, where, MAKE_AGAIN) from error


def _of_the_system(error: Exception) -> OSError | None:
    """Return the system's error, which torch puts behind one of its own and safetensors into a text."""
    if isinstance(error, OSError):
        return error
    behind = error.__context__
    if isinstance(error, RuntimeError) and isinstance(behind, OSError) and behind.errno in _FULL:
        return behind
    number = _OF_RUST.search(str(error))
    return OSError(int(number[1]), os.strerror(int(number[1]))) if number else None
