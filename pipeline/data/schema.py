"""Schemas of the NPZ files of artifacts: key, axes and dtype of every array, checked on save and load.

A module per artifact kind declares its files as `FileSchema` and offers typed readers and writers over it
(`Stored` has those of a dataclass); `tests/test_data_layout.py` compares every schema with `data_layout.md`.
"""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Self

import numpy as np
from jaxtyping import Shaped

from pipeline.core.errors import InputError
from pipeline.data import npz

_SPEC = re.compile(
    r"(?P<key>\w+) \[(?P<axes>[^\]]*)\] (?P<dtype>f2|f4|f8|u1|u2|i4|i8|bool|U)(?P<optional>\?)?"
)


@dataclass(frozen=True)
class ArraySchema:
    """One array: axis names or fixed lengths in order, and the dtype on disk."""

    axes: tuple[str, ...]
    dtype: str
    optional: bool = False


@dataclass(frozen=True)
class FileSchema:
    """The arrays of one NPZ file, by key."""

    file: str
    """`<artifact>/<file>` as in `data_layout.md`"""
    arrays: dict[str, ArraySchema]

    @classmethod
    def of(cls, file: str, *specs: str) -> "FileSchema":
        """Make a schema from lines such as `confidence [frame] f4?`, whose `?` marks an optional array."""
        arrays = {}
        for spec in specs:
            match = _SPEC.fullmatch(spec)
            assert match, spec
            arrays[match["key"]] = ArraySchema(
                tuple(match["axes"].split()), match["dtype"], bool(match["optional"])
            )
        return cls(file, arrays)

    def save(self, path: Path, *, compress: bool = False, **arrays: np.ndarray | None) -> None:
        """Write the arrays in the schema's order and dtypes; None leaves an optional one out."""
        given = {key: array for key, array in arrays.items() if array is not None}
        known = {key: np.asarray(given[key], self._dtype(key)) for key in self.arrays if key in given}
        problem = self._problem(known) if given.keys() <= self.arrays.keys() else f"unknown {given.keys()}"
        assert problem is None, (self.file, problem)
        npz.save(path, compress=compress, **known)

    def load(self, path: Path, *keys: str) -> dict[str, Shaped[np.ndarray, "..."]]:
        """Read arrays (default: all) in the schema's dtypes. Raises ART-010 if they are not as declared."""
        wanted = keys or tuple(self.arrays)
        required = tuple(key for key in wanted if not self.arrays[key].optional)
        stored = npz.load(path, required, optional=wanted)
        problem = self._problem(stored, wanted)
        if problem is not None:
            what = f"not a {self.file}: {problem}"
            raise InputError("ART-010", what, str(path), "rebuild the stage that wrote it")
        kinds = {key: self._dtype(key) or array.dtype for key, array in stored.items()}
        return {key: array.astype(kinds[key], copy=False) for key, array in stored.items()}

    def _dtype(self, key: str) -> np.dtype | None:
        """Return the dtype on disk; None for text, which has no fixed length."""
        return None if self.arrays[key].dtype == "U" else np.dtype(self.arrays[key].dtype)

    def _problem(self, stored: dict[str, np.ndarray], wanted: tuple[str, ...] | None = None) -> str | None:
        """Return how arrays violate the schema: missing keys, wrong kinds, axes or lengths."""
        lengths: dict[str, int] = {}
        for key in self.arrays if wanted is None else wanted:
            schema = self.arrays[key]
            if key not in stored and schema.optional:
                continue
            if key not in stored:
                return f"{key} is missing"
            array = stored[key]
            if array.dtype.kind != np.dtype(schema.dtype).kind:
                return f"{key} holds {array.dtype} instead of {schema.dtype}"
            if array.ndim != len(schema.axes):
                return f"{key} has {array.ndim} axes instead of {' '.join(schema.axes) or 'none'}"
            for axis, length in zip(schema.axes, array.shape, strict=True):
                if lengths.setdefault(axis, int(axis) if axis.isdigit() else length) != length:
                    return f"{key} has {length} along {axis} instead of {lengths[axis]}"
        return None


class Stored:
    """The base of dataclasses whose fields are the arrays of one file."""

    schema: ClassVar[FileSchema]

    @classmethod
    def open(cls, folder: Path) -> Self:
        """Read the file of a finished artifact. Raises InputError ART-010."""
        return cls(**cls.schema.load(folder / Path(cls.schema.file).name))

    def write(self, folder: Path) -> None:
        """Write the file into an artifact in the making."""
        self.schema.save(folder / Path(self.schema.file).name, **vars(self))
