"""The one error that a user can cause and therefore can repair.

Everything else that goes wrong is a broken promise of ours: an `assert` or a plain traceback. Standard
library only.
"""

import contextlib
import errno
from collections.abc import Iterator


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
    """Return text whose control characters are spelled out.

    Names of files may hold ESC, which terminals obey.
    """
    return "".join(c if c.isprintable() or c == "\n" else c.encode("unicode_escape").decode() for c in text)


@contextlib.contextmanager
def coded_disk_errors(where: str) -> Iterator[None]:
    """Turn an `OSError` that the user can cure into an `InputError`: SYS-001 (full), SYS-003 (forbidden)."""
    try:
        yield
    except OSError as error:
        place = str(error.filename or where)
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise InputError(
                "SYS-001", "the disk is full", place, "free some space and run the same again"
            ) from error
        if error.errno in (errno.EROFS, errno.EACCES, errno.EPERM):
            remedy = "look at who owns it and whether the disk is mounted read-only, then run the same again"
            raise InputError("SYS-003", f"cannot be used: {error.strerror}", place, remedy) from error
        raise
