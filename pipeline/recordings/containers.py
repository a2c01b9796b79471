"""Safe access to the members of a recording: an untrusted ZIP archive, or a folder.

Nothing is extracted to disk: members are checked when the container is opened and read one at a time, at most
``max_bytes`` each.
"""

import codecs
import json
import lzma
import stat
import struct
import zipfile
import zlib
from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float32, UInt, UInt8

from pipeline.core.errors import InputError
from pipeline.data import images
from pipeline.recordings import errors

MAX_MEMBER_BYTES = 64 << 20
UNKNOWN = 65535
"""value of 16-bit depth pictures, besides 0, for unknown depth"""
MAX_MEMBERS = 1_000_000
"""maximum number of members, 0.6 GB when listed: 90 minutes at 60 Hz with three files per frame"""
MEMBERS_PER_FRAME, EXTRA_MEMBERS = 4, 1000
"""maximum members per declared frame (color, depth, confidence, one more), and in addition"""
GIB = 1 << 30
MAX_TOTAL_BYTES = 256 * GIB
MAX_RATIO = 200
"""compression ratio beyond which a member counts as a ZIP bomb"""
SMALL_BYTES = 1 << 16
"""members up to this size never count as ZIP bombs"""
MAX_DIGITS = 18
"""maximum digits of a frame number in a file name: it fits 64 bits"""
DIRECTORY_ENTRY_BYTES = 47
"""minimum size of an entry in a ZIP's central directory"""
_END_OF_DIRECTORY, _END_OF_DIRECTORY_64 = b"PK\x05\x06", b"PK\x06\x06"
_SIZE_AT, _COUNT_AT, _SIZES_64_AT = 12, 10, 32
"""offsets in the end of central directory record: directory size, number of entries; both in ZIP64's"""
_TAIL_BYTES = (1 << 16) + 22 + 20 + 56
"""maximum length of a ZIP's end: comment, end of central directory, ZIP64 locator and record"""
_UNREADABLE = (
    zipfile.BadZipFile, EOFError, zlib.error, lzma.LZMAError, struct.error, ValueError, NotImplementedError,
    RuntimeError, OverflowError, OSError,
)  # fmt: skip
"""what zipfile raises for archives that are damaged, encrypted, inconsistent or of unknown compression"""


class Container(ABC):
    """Named members of a recording."""

    where: str
    """path for messages"""
    names: frozenset[str]

    @abstractmethod
    def read(self, name: str, max_bytes: int = MAX_MEMBER_BYTES) -> bytes:
        """Read one member. Raises InputError if it is damaged or longer than ``max_bytes``."""

    def place(self, name: str) -> str:
        """Return a member's name for messages."""
        return f"{self.where}/{name}"

    def text(self, name: str) -> str:
        """Read a text in UTF-8, or UTF-16 with a byte order mark; invalid bytes are replaced."""
        data = self.read(name)
        utf_16 = data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
        return data.decode("utf-16" if utf_16 else "utf-8-sig", errors="replace")

    def table(self, name: str) -> dict[str, Any]:
        """Read a JSON table. Raises CAP-004."""
        try:
            table = json.loads(self.read(name))
        except (ValueError, RecursionError) as error:
            raise errors.broken_metadata(self.place(name), f"not JSON ({error})") from error
        if not isinstance(table, dict):
            raise errors.broken_metadata(self.place(name), "not a table")
        return table

    def color(self, name: str) -> UInt8[np.ndarray, "height width 3"]:
        """Read a color picture. Raises CAP-020."""
        return images.decode_color(self.read(name), self.place(name))

    def gray(self, name: str, dtype: type = np.uint8) -> UInt[np.ndarray, "height width"]:
        """Read a single-channel PNG of 8 bits (confidence) or 16 (depth). Raises CAP-008 for others."""
        image = images.decoded(self.read(name), cv2.IMREAD_UNCHANGED)
        if image is None or image.ndim != 2 or image.dtype != dtype:
            bits = 8 * np.dtype(dtype).itemsize
            raise errors.wrong_depth(self.place(name), f"not a readable {bits}-bit single-channel PNG")
        return image

    def meters(
        self, name: str, size: tuple[int, int] | None = None, per_meter: float = 1000.0
    ) -> Float32[np.ndarray, "height width"]:
        """Read a 16-bit depth PNG of (height, width) ``size`` as meters, 0 = unknown. Raises CAP-008."""
        raw = self.gray(name, np.uint16)
        errors.refuse_other_size(raw.shape, size, self.place(name))
        return np.where(raw == UNKNOWN, 0, raw).astype(np.float32) / np.float32(per_meter)

    def refuse_surplus_members(self, frames: int) -> None:
        """Raise CAP-002 for too many members for the number of frames in the metadata."""
        most = MEMBERS_PER_FRAME * frames + EXTRA_MEMBERS
        if len(self.names) > most:
            raise _unsafe(self.where, f"{len(self.names)} members for {frames} frames, at most {most}")

    def numbered(self, folder: str, *suffixes: str) -> dict[int, str]:
        """Return a folder's members named by frame number, by number; only with these suffixes, if any."""
        found = {}
        for name in sorted(name for name in self.names if name.rpartition("/")[0] == folder):
            number, suffix = frame_number(Path(name).stem), Path(name).suffix.lower()
            if number is not None and (not suffixes or suffix in suffixes):
                found[number] = name
        return found


class FolderContainer(Container):
    """A folder's files by relative path, without hidden files and symbolic links."""

    def __init__(self, folder: Path) -> None:
        self.where = str(folder)
        self._folder = folder
        files = (path for path in folder.rglob("[!.]*") if path.is_file() and not path.is_symlink())
        self.names = frozenset(path.relative_to(folder).as_posix() for path in files)

    def path(self, name: str) -> Path:
        """Return the path of a regular file. Raises CAP-001 for links, pipes and missing names."""
        if name not in self.names:
            raise errors.damaged(self.place(name), "there is no such file; links are not followed")
        return self._folder / name

    def read(self, name: str, max_bytes: int = MAX_MEMBER_BYTES) -> bytes:
        """Read one file of at most ``max_bytes``."""
        try:
            with open(self.path(name), "rb") as file:
                return _within(file.read(max_bytes + 1), max_bytes, self.place(name))
        except OSError as error:
            raise errors.unreadable(self.place(name), error) from error


class ZipContainer(Container):
    """A ZIP's members, after a check of its central directory for unsafe ones."""

    def __init__(self, path: Path) -> None:
        self.where = str(path)
        try:
            declared = _declared_members(path)
            if declared > MAX_MEMBERS:
                raise _unsafe(self.where, f"{declared} members, at most {MAX_MEMBERS} are read")
            self._archive = zipfile.ZipFile(path)
        except _UNREADABLE as error:
            raise errors.unreadable(self.where, error) from error
        _refuse_unsafe(self._archive.infolist(), self.where)
        self.names = frozenset(info.filename for info in self._archive.infolist() if not info.is_dir())

    def read(self, name: str, max_bytes: int = MAX_MEMBER_BYTES) -> bytes:
        """Read one member of at most ``max_bytes``; its checksum is verified."""
        try:
            with self._archive.open(name) as member:
                return _within(member.read(max_bytes + 1), max_bytes, self.place(name))
        except _UNREADABLE as error:
            raise errors.damaged(self.place(name), str(error)) from error


def frame_number(stem: str) -> int | None:
    """Return the frame number in a file name's stem; None if it is not a number."""
    return int(stem) if stem.isascii() and stem.isdigit() and len(stem) <= MAX_DIGITS else None


def _declared_members(path: Path) -> int:
    """Return the number of members that a ZIP declares, before its directory is read into memory."""
    with open(path, "rb") as file:
        file.seek(max(path.stat().st_size - _TAIL_BYTES, 0))
        tail = file.read()
    end, end_64 = tail.rfind(_END_OF_DIRECTORY), tail.rfind(_END_OF_DIRECTORY_64)
    if end < 0 or len(tail) < end + _SIZE_AT:
        raise zipfile.BadZipFile("it has no directory")
    count = struct.unpack_from("<H", tail, end + _COUNT_AT)[0]
    directory = struct.unpack_from("<I", tail, end + _SIZE_AT)[0] if len(tail) >= end + _SIZE_AT + 4 else 0
    if end_64 >= 0 and len(tail) >= end_64 + _SIZES_64_AT + 16:
        count, directory = struct.unpack_from("<2Q", tail, end_64 + _SIZES_64_AT)
    return max(count, directory // DIRECTORY_ENTRY_BYTES)


def _within(data: bytes, max_bytes: int, where: str) -> bytes:
    if len(data) > max_bytes:
        raise _unsafe(where, f"it holds more than {max_bytes} bytes where a recording holds fewer")
    return data


def _unsafe(where: str, why: str) -> InputError:
    remedy = "use the file that the recording app exported, unchanged"
    return InputError("CAP-002", f"the archive is refused: {why}", where, remedy)


def _refuse_unsafe(members: list[zipfile.ZipInfo], where: str) -> None:
    """Raise CAP-002 for too many, too large, encrypted, linked, duplicate or escaping members, ZIP bombs."""
    if len(members) > MAX_MEMBERS:
        raise _unsafe(where, f"{len(members)} members, at most {MAX_MEMBERS} are read")
    if sum(info.file_size for info in members) > MAX_TOTAL_BYTES:
        raise _unsafe(where, f"it unpacks to more than {MAX_TOTAL_BYTES // GIB} GiB")
    if len({info.filename for info in members}) != len(members):
        raise _unsafe(where, "two members share one name")
    for info in members:
        why = _fault_of(info)
        if why:
            raise _unsafe(f"{where}:{info.filename!r}", why)


def _fault_of(info: zipfile.ZipInfo) -> str | None:
    """Return what is unsafe about a member, if anything."""
    name = info.orig_filename
    parts = name.split("/")
    if "\\" in name or "\0" in name or ":" in name or name.startswith("/") or ".." in parts:
        return "a member's name leads outside of it"
    if stat.S_ISLNK(info.external_attr >> 16):
        return "a member is a link"
    if info.flag_bits & 1:
        return "a member is encrypted"
    if info.file_size > SMALL_BYTES and info.file_size > MAX_RATIO * max(info.compress_size, 1):
        return f"a member unpacks to more than {MAX_RATIO} times its size (zip bomb)"
    return None
