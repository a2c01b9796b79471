"""Guarded access to the members of a recording: a ZIP that may be hostile, or a folder.

Nothing is ever extracted to disk: members are checked when the container opens and read one at a time, at most
``max_bytes`` each.
"""

import stat
import zipfile
import zlib
from pathlib import Path, PurePosixPath
from typing import Protocol

from pipeline.errors import InputError
from pipeline.recordings.recording import damaged

MAX_MEMBERS = 200_000
MAX_TOTAL_BYTES = 64 << 30
MAX_RATIO = 200
SMALL_BYTES = 1 << 16


class Container(Protocol):
    """Named members of a recording."""

    where: str
    """shown in messages"""
    names: frozenset[str]

    def read(self, name: str, max_bytes: int) -> bytes:
        """Read one member. Raises InputError when it is damaged or longer than ``max_bytes``."""


class FolderContainer:
    """A folder's files, addressed by their relative paths; links are not followed."""

    def __init__(self, folder: Path) -> None:
        self.where = str(folder)
        self._folder = folder
        files = (path for path in folder.rglob("*") if path.is_file() and not path.is_symlink())
        self.names = frozenset(path.relative_to(folder).as_posix() for path in files)

    def path(self, name: str) -> Path:
        """Return where a member lies."""
        return self._folder / name

    def read(self, name: str, max_bytes: int) -> bytes:
        """Read one file of at most ``max_bytes``."""
        where = f"{self.where}/{name}"
        try:
            with open(self.path(name), "rb") as file:
                return _within(file.read(max_bytes + 1), max_bytes, where)
        except OSError as error:
            raise damaged(where, error.strerror or str(error)) from error


class ZipContainer:
    """A ZIP's members, after its directory has been checked for anything a recording never holds."""

    def __init__(self, path: Path) -> None:
        self.where = str(path)
        try:
            self._archive = zipfile.ZipFile(path)
        except (zipfile.BadZipFile, EOFError, ValueError, NotImplementedError) as error:
            raise damaged(self.where, str(error)) from error
        _refuse_unsafe(self._archive.infolist(), self.where)
        self.names = frozenset(info.filename for info in self._archive.infolist() if not info.is_dir())

    def read(self, name: str, max_bytes: int) -> bytes:
        """Read one member of at most ``max_bytes``; its checksum is verified."""
        where = f"{self.where}:{name}"
        try:
            with self._archive.open(name) as member:
                return _within(member.read(max_bytes + 1), max_bytes, where)
        except (zipfile.BadZipFile, EOFError, zlib.error, NotImplementedError, OSError) as error:
            raise damaged(where, str(error)) from error


def _within(data: bytes, max_bytes: int, where: str) -> bytes:
    if len(data) > max_bytes:
        raise _unsafe(where, f"it holds more than {max_bytes} bytes where a recording holds fewer")
    return data


def _unsafe(where: str, why: str) -> InputError:
    return InputError(
        "CAP-002",
        what=f"the archive is refused: {why}",
        where=where,
        remedy="use the file that the recording app exported, unchanged",
    )


def _refuse_unsafe(members: list[zipfile.ZipInfo], where: str) -> None:
    """Refuse archives with too many, too large, too dense, encrypted, linked, doubled or escaping members."""
    if len(members) > MAX_MEMBERS:
        raise _unsafe(where, f"{len(members)} members, at most {MAX_MEMBERS} are read")
    if sum(info.file_size for info in members) > MAX_TOTAL_BYTES:
        raise _unsafe(where, f"it unpacks to more than {MAX_TOTAL_BYTES >> 30} GiB")
    if len({info.filename for info in members}) != len(members):
        raise _unsafe(where, "two members share one name")
    for info in members:
        why = _fault_of(info)
        if why:
            raise _unsafe(f"{where}:{info.filename!r}", why)


def _fault_of(info: zipfile.ZipInfo) -> str | None:
    """Name what is wrong with a member, if anything."""
    name = info.orig_filename
    parts = PurePosixPath(name).parts
    if "\\" in name or "\0" in name or ":" in name or name.startswith("/") or ".." in parts:
        return "a member's name leads outside of it"
    if stat.S_ISLNK(info.external_attr >> 16):
        return "a member is a link"
    if info.flag_bits & 1:
        return "a member is encrypted"
    if info.file_size > SMALL_BYTES and info.file_size > MAX_RATIO * max(info.compress_size, 1):
        return f"a member unpacks to more than {MAX_RATIO} times its size (zip bomb)"
    return None
