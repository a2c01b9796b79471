"""Small text files beside pictures: tables of numbers and the intrinsics that formats without metadata need."""

import numpy as np
from jaxtyping import Float

from pipeline.errors import InputError
from pipeline.recordings.containers import Container
from pipeline.recordings.recording import MAX_TEXT_BYTES, broken_metadata

INTRINSICS = ("intrinsics.txt", "camera-intrinsics.txt", "camera_matrix.csv")
"""3 x 3 or 4 x 4 matrix, or the four numbers fx fy cx cy, in colour pixels"""


def lines(container: Container, name: str) -> list[str]:
    """Return a member's lines without comments and blanks."""
    text = container.read(name, MAX_TEXT_BYTES).decode(errors="replace")
    return [line.strip() for line in text.splitlines() if line.strip() and not line.lstrip().startswith("#")]


def table(text: str, columns: int, where: str, rows: int | None = None) -> Float[np.ndarray, "row column"]:
    """Read numbers in columns separated by blanks or commas; raises CAP-004 when they are no such table."""
    kept = [line for line in text.replace(",", " ").splitlines() if line.strip() and not line.lstrip().startswith("#")]
    try:
        read = np.array([[_number(cell) for cell in line.split()] for line in kept], float).reshape(len(kept), columns)
    except ValueError as error:
        raise broken_metadata(where, f"not a table of {columns} columns of numbers") from error
    if rows is not None and len(read) != rows:
        raise broken_metadata(where, f"{len(read)} rows instead of {rows}")
    return read


def _number(cell: str) -> float:
    """Read a number; what old Windows programs write for none (``-1.#IND``) is NaN."""
    return np.nan if ".#" in cell else float(cell)


def coefficients(container: Container, default: tuple[float, ...] | None) -> tuple[Float[np.ndarray, "4"], tuple[str, ...]]:
    """Return (fx, fy, cx, cy) from a file beside the pictures, or the default and a remark. Raises CAP-011 without either."""
    name = next((name for name in INTRINSICS if name in container.names), None)
    if name is None and default is None:
        what = "nothing tells the focal length of these pictures"
        raise InputError("CAP-011", what, container.where, "write intrinsics.txt with the four numbers fx fy cx cy, in colour pixels")
    if name is None:
        assert default is not None
        return np.array(default), (f"no intrinsics.txt: the default fx {default[0]:g}, cx {default[2]:g}, cy {default[3]:g} is assumed",)
    text = container.read(name, MAX_TEXT_BYTES).decode(errors="replace").replace(",", " ")
    where = f"{container.where}/{name}"
    try:
        numbers = np.array([float(cell) for cell in text.split()])
    except ValueError as error:
        raise broken_metadata(where, "it holds more than numbers") from error
    if len(numbers) == 4:
        return numbers, ()
    if len(numbers) in (9, 16):
        side = 3 if len(numbers) == 9 else 4
        return numbers.reshape(side, side)[[0, 1, 0, 1], [0, 1, 2, 2]], ()
    raise broken_metadata(where, f"{len(numbers)} numbers are neither fx fy cx cy nor a matrix")
