"""NPZ files: written deterministically (fixed timestamps), read without pickle.

`save` writes, `Rows` writes what does not fit into memory, `load` reads everything after checking each
header, `open_lazily` maps big uncompressed members, `Column` keeps what only this process needs out of
memory.
"""

import contextlib
import lzma
import math
import shutil
import struct
import tempfile
import tokenize
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import IO

import numpy as np
from jaxtyping import Shaped

from pipeline.core.errors import InputError

MAX_BYTES = 64 << 30
"""maximum size of an array: more than the memory of our machines"""
_EPOCH = (1980, 1, 1, 0, 0, 0)
_LOCAL_LENGTHS, _LOCAL_HEADER = 26, 30
"""offset of the lengths of name and extra field in a ZIP's local header, and its size without them, bytes"""
_BROKEN = (
    zipfile.BadZipFile, zlib.error, lzma.LZMAError, ValueError, KeyError, OSError, EOFError, RuntimeError,
    NotImplementedError, OverflowError, MemoryError, TypeError, SyntaxError,
    tokenize.TokenError, struct.error,
)  # fmt: skip
"""what zipfile and numpy raise for damaged, encrypted, inconsistent or unsupported archives"""


def save(path: Path, *, compress: bool = False, **arrays: np.ndarray) -> None:
    """Write named arrays; the same arrays always give the same bytes. Names may contain ``/``."""
    method = zipfile.ZIP_DEFLATED if compress else zipfile.ZIP_STORED
    with zipfile.ZipFile(path, "w", method, compresslevel=3) as archive:
        for name, array in arrays.items():
            array = np.asanyarray(array)
            assert array.dtype != object, name
            info = zipfile.ZipInfo(f"{name}.npy", date_time=_EPOCH)
            info.compress_type = method
            with archive.open(info, "w", force_zip64=True) as member:
                np.lib.format.write_array(member, array, allow_pickle=False)


class Rows:
    """Arrays written row by row in a ``with`` block, to the same bytes as by `save`."""

    def __init__(self, path: Path, **arrays: tuple[tuple[int, ...], type]) -> None:
        """Start a file of arrays with these shapes (number of rows first) and dtypes."""
        self._path = path
        self._kinds = {name: (shape, np.dtype(kind)) for name, (shape, kind) in arrays.items()}
        self._parts = {name: tempfile.TemporaryFile(dir=path.parent) for name in arrays}

    def append(self, **rows: Shaped[np.ndarray, "..."]) -> None:
        """Add one row to each of the named arrays."""
        for name, row in rows.items():
            (_, *shape), dtype = self._kinds[name]
            assert row.shape == tuple(shape) and row.dtype == dtype, (name, row.shape, row.dtype)
            self._parts[name].write(row.tobytes())

    def __enter__(self) -> "Rows":
        return self

    def __exit__(self, failed: type | None, *_: object) -> None:
        with contextlib.ExitStack() as parts:
            for part in self._parts.values():
                parts.enter_context(part)
            if failed:
                return
            archive = parts.enter_context(zipfile.ZipFile(self._path, "w"))
            for name, (shape, dtype) in self._kinds.items():
                part = self._parts[name]
                assert part.tell() == int(np.prod(shape)) * dtype.itemsize, (name, part.tell(), shape)
                part.seek(0)
                kind = np.lib.format.dtype_to_descr(dtype)
                header = {"descr": kind, "fortran_order": False, "shape": shape}
                info = zipfile.ZipInfo(f"{name}.npy", date_time=_EPOCH)
                with archive.open(info, "w", force_zip64=True) as member:
                    np.lib.format.write_array_header_1_0(member, header)
                    shutil.copyfileobj(part, member, 1 << 20)


class Column:
    """Rows of one array in an unlinked temporary file, memory-mapped for reading."""

    def __init__(self, folder: Path | None) -> None:
        """Create the file in ``folder``; None: in the default folder for temporary files."""
        self._file, self._rows, self._like = tempfile.TemporaryFile(dir=folder), 0, np.zeros(0)

    def append(self, rows: Shaped[np.ndarray, "row ..."]) -> "Column":
        """Append rows."""
        self._file.write(np.ascontiguousarray(rows).data)
        self._rows, self._like = self._rows + len(rows), rows[:0].copy()
        return self

    def array(self) -> Shaped[np.ndarray, "row ..."]:
        """Return all rows."""
        if not self._rows:
            return self._like
        self._file.flush()
        return np.memmap(self._file, self._like.dtype, "r+", shape=(self._rows, *self._like.shape[1:]))


def load(
    path: Path, names: tuple[str, ...] | None = None, optional: tuple[str, ...] = (), most: int = MAX_BYTES
) -> dict[str, Shaped[np.ndarray, "..."]]:
    """Read the named arrays (default: all) and those ``optional`` ones that are there.

    Raises InputError ART-010 for damaged files, missing names, object arrays and more than ``most`` bytes.
    """
    with _readable(path) as archive:
        members = [name.removesuffix(".npy") for name in archive.namelist() if name.endswith(".npy")]
        missing = set(names or ()) - set(members)
        if missing:
            raise ValueError(f"missing {', '.join(sorted(missing))}; it holds {', '.join(members)}")
        wanted = members if names is None else [*names, *(set(optional) & set(members) - set(names))]
        if sum(archive.getinfo(f"{name}.npy").file_size for name in wanted) > most:
            raise ValueError(f"it unpacks to more than {most} bytes")
        return {name: _read(archive, name) for name in wanted}


def open_lazily(path: Path, name: str) -> Shaped[np.ndarray, "..."]:
    """Memory-map one uncompressed member, read-only. Raises ART-010 for damaged files and missing names."""
    with _readable(path) as archive:
        info = archive.getinfo(f"{name}.npy")
        if info.compress_type != zipfile.ZIP_STORED:
            return _read(archive, name)
        with archive.open(info) as member:
            shape, fortran, dtype = _header(member, name, info.file_size)
            offset = member.tell()
        with open(path, "rb") as file:
            file.seek(info.header_offset + _LOCAL_LENGTHS)
            name_length, extra_length = np.frombuffer(file.read(4), "<u2")
        start = info.header_offset + _LOCAL_HEADER + int(name_length) + int(extra_length) + offset
        return np.memmap(path, dtype, "r", start, shape, "F" if fortran else "C")


@contextlib.contextmanager
def _readable(path: Path) -> Iterator[zipfile.ZipFile]:
    """Open an archive; errors from reading a damaged one become ART-010."""
    try:
        with zipfile.ZipFile(path) as archive:
            yield archive
    except _BROKEN as error:
        what = f"cannot be read as NPZ: {error}"
        raise InputError("ART-010", what, str(path), "rebuild the stage that wrote it") from error


def _read(archive: zipfile.ZipFile, name: str) -> np.ndarray:
    """Read one member after checking its header's size and dtype."""
    info = archive.getinfo(f"{name}.npy")
    with archive.open(info) as member:
        _header(member, name, info.file_size)
    with archive.open(info) as member:
        return np.lib.format.read_array(member, allow_pickle=False)


def _header(member: IO[bytes], name: str, member_bytes: int) -> tuple[tuple[int, ...], bool, np.dtype]:
    """Read an array's shape, order and dtype and leave ``member`` at its first value.

    Raises ValueError for objects and for arrays that would not fit into the member.
    """
    major, _ = np.lib.format.read_magic(member)
    reader = {1: np.lib.format.read_array_header_1_0, 2: np.lib.format.read_array_header_2_0}.get(major)
    if reader is None:
        raise ValueError(f"{name}: unknown array format")
    shape, fortran, dtype = reader(member)
    size = math.prod(shape) * dtype.itemsize
    if dtype.hasobject or any(length < 0 for length in shape) or size > min(member_bytes, MAX_BYTES):
        raise ValueError(f"{name}: {dtype} of {size} bytes is refused")
    return shape, fortran, dtype
