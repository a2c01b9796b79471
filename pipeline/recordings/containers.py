"""Guarded access to the members of a recording: a ZIP that may be hostile, or a folder.

Nothing is ever extracted to disk: members are checked when the container opens and read one at a time, at
most ``max_bytes`` each.
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
from pipeline.recordings.recording import broken_metadata, damaged, refuse_other_size, wrong_depth

MAX_MEMBER_BYTES = 64 << 20
UNKNOWN = 65535
"""what 16-bit depth pictures hold, beside 0, where nothing was measured"""
MAX_MEMBERS = 1_000_000
"""members that are listed at all, in 0.6 GB of memory: 90 minutes at 60 Hz with three files a frame"""
MEMBERS_PER_FRAME, MEMBERS_BESIDE = 4, 1000
"""members that a recording may hold per declared frame (colour, depth, confidence, one more), and beside"""
GIB = 1 << 30
MAX_TOTAL_BYTES = 256 * GIB
MAX_RATIO = 200
"""unpacked over packed size beyond which a member is no picture but a bomb"""
SMALL_BYTES = 1 << 16
"""members up to this size are never called bombs"""
MAX_DIGITS = 18
"""of a frame number in a file name: what 64 bits hold"""
DIRECTORY_ENTRY_BYTES = 47
"""least size of a member's entry in a ZIP's directory"""
_END_OF_DIRECTORY, _END_OF_DIRECTORY_64 = b"PK\x05\x06", b"PK\x06\x06"
_SIZE_AT, _COUNT_AT, _SIZES_64_AT = 12, 10, 32
"""offsets in the end of the directory: its size, the number of its entries; both in the 64-bit record"""
_TAIL_BYTES = (1 << 16) + 22 + 20 + 56
"""longest end of a ZIP: comment, end of directory, its 64-bit locator and record"""
_UNREADABLE = (
    zipfile.BadZipFile, EOFError, zlib.error, lzma.LZMAError, struct.error, ValueError, NotImplementedError,
    RuntimeError, OverflowError, OSError,
)  # fmt: skip
"""what zipfile raises for archives that are damaged, encrypted, of unknown methods, or lie"""


class Container(ABC):
    """Named members of a recording."""

    where: str
    """shown in messages"""
    names: frozenset[str]

    @abstractmethod
    def read(self, name: str, max_bytes: int = MAX_MEMBER_BYTES) -> bytes:
        """Read one member. Raises InputError when it is damaged or longer than ``max_bytes``."""

    def place(self, name: str) -> str:
        """Return a member's name for messages."""
        return f"{self.where}/{name}"

    def text(self, name: str) -> str:
        """Read a text, UTF-8 or as Windows saves it, with a mark; what is neither is replaced."""
        data = self.read(name)
        wide = data.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
        return data.decode("utf-16" if wide else "utf-8-sig", errors="replace")

    def table(self, name: str) -> dict[str, Any]:
        """Read a JSON table. Raises CAP-004."""
        try:
            table = json.loads(self.read(name))
        except (ValueError, RecursionError) as error:
            raise broken_metadata(self.place(name), f"not JSON ({error})") from error
        if not isinstance(table, dict):
            raise broken_metadata(self.place(name), "not a table")
        return table

    def color(self, name: str) -> UInt8[np.ndarray, "height width 3"]:
        """Read a colour picture. Raises CAP-020."""
        return images.decode_color(self.read(name), self.place(name))

    def gray(self, name: str, dtype: type = np.uint8) -> UInt[np.ndarray, "height width"]:
        """Read a single-channel PNG of 8 bits (confidence) or 16 (depth). Raises CAP-008 for others."""
        image = images.decoded(self.read(name), cv2.IMREAD_UNCHANGED)
        if image is None or image.ndim != 2 or image.dtype != dtype:
            bits = 8 * np.dtype(dtype).itemsize
            raise wrong_depth(self.place(name), f"not a readable {bits}-bit single-channel PNG")
        return image

    def meters(
        self, name: str, size: tuple[int, int] | None = None, per_meter: float = 1000.0
    ) -> Float32[np.ndarray, "height width"]:
        """Read a 16-bit depth PNG of (height, width) ``size`` as metres, 0 = unknown. Raises CAP-008."""
        raw = self.gray(name, np.uint16)
        refuse_other_size(raw.shape, size, self.place(name))
        return np.where(raw == UNKNOWN, 0, raw).astype(np.float32) / np.float32(per_meter)

    def numbered(self, folder: str, *suffixes: str) -> dict[int, str]:
        """Return the members of a folder that are named by frame number, by it; of these suffixes, if any."""
        found = {}
        for name in sorted(name for name in self.names if name.startswith(f"{folder}/")):
            number, suffix = frame_number(Path(name).stem), Path(name).suffix.lower()
            if number is not None and (not suffixes or suffix in suffixes):
                found[number] = name
        return found


class FolderContainer(Container):
    """A folder's files, addressed by their relative paths; links are not followed, hidden files not seen."""

    def __init__(self, folder: Path) -> None:
        self.where = str(folder)
        self._folder = folder
        files = (path for path in folder.rglob("[!.]*") if path.is_file() and not path.is_symlink())
        self.names = frozenset(path.relative_to(folder).as_posix() for path in files)

    def path(self, name: str) -> Path:
        """Return where a regular file lies. Raises CAP-001 for links, pipes and names that are not there."""
        if name not in self.names:
            raise damaged(self.place(name), "there is no such regular file")
        return self._folder / name

    def read(self, name: str, max_bytes: int = MAX_MEMBER_BYTES) -> bytes:
        """Read one file of at most ``max_bytes``."""
        try:
            with open(self.path(name), "rb") as file:
                return _within(file.read(max_bytes + 1), max_bytes, self.place(name))
        except OSError as error:
            raise damaged(self.place(name), error.strerror or str(error)) from error


class ZipContainer(Container):
    """A ZIP's members, after its directory has been checked for anything a recording never holds."""

    def __init__(self, path: Path) -> None:
        self.where = str(path)
        try:
            declared = _declared_members(path)
            if declared > MAX_MEMBERS:
                raise _unsafe(self.where, f"{declared} members, at most {MAX_MEMBERS} are read")
            self._archive = zipfile.ZipFile(path)
        except _UNREADABLE as error:
            raise damaged(self.where, str(error)) from error
        _refuse_unsafe(self._archive.infolist(), self.where)
        self.names = frozenset(info.filename for info in self._archive.infolist() if not info.is_dir())

    def read(self, name: str, max_bytes: int = MAX_MEMBER_BYTES) -> bytes:
        """Read one member of at most ``max_bytes``; its checksum is verified."""
        try:
            with self._archive.open(name) as member:
                return _within(member.read(max_bytes + 1), max_bytes, self.place(name))
        except _UNREADABLE as error:
            raise damaged(self.place(name), str(error)) from error


def refuse_surplus_members(container: Container, frames: int) -> None:
    """Raise CAP-002 where a container holds more members than its metadata's count of frames accounts for."""
    most = MEMBERS_PER_FRAME * frames + MEMBERS_BESIDE
    if len(container.names) > most:
        raise _unsafe(container.where, f"{len(container.names)} members for {frames} frames, at most {most}")


def frame_number(stem: str) -> int | None:
    """Return the number that a file name is, None for any other name."""
    return int(stem) if stem.isascii() and stem.isdigit() and len(stem) <= MAX_DIGITS else None


def _declared_members(path: Path) -> int:
    """Read how many members a ZIP's end declares, before its directory is read into memory."""
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
    """Refuse archives with too many, too large, too dense, encrypted, linked, doubled or escaping members."""
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
    """Name what is wrong with a member, if anything."""
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
