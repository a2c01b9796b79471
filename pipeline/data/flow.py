"""Optical flow of one recording as files: `flow/<id>/flow_<gap>_{fw,bw}.npz`, mapped lazily."""

from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from pipeline.data import npz
from pipeline.data.schema import FileSchema

STRIDE_PX = 4
"""stride of the flow grid, color pixels"""
GAPS = (1, 2, 4, 8)
"""frames between the two pictures of a pair"""
FLOW = FileSchema.of(
    "flow/flow_<gap>_{fw,bw}.npz", "flow [frame height width 2] f2", "confidence [frame height width] u1"
)


def path_of(folder: Path, gap: int, *, backward: bool = False) -> Path:
    """Return the file of one gap: frame i to i + gap, or ``backward`` from i + gap to i."""
    return folder / f"flow_{gap}_{'bw' if backward else 'fw'}.npz"


def open_flow(folder: Path, gap: int, *, backward: bool = False) -> Float[np.ndarray, "frame height width 2"]:
    """Map the flow of one gap, color pixels, per cell of `STRIDE_PX`."""
    return npz.open_lazily(path_of(folder, gap, backward=backward), "flow")


def open_confidence(
    folder: Path, gap: int, *, backward: bool = False
) -> UInt8[np.ndarray, "frame height width"]:
    """Map the confidence of one gap from disk, 0..255, 255 = certain."""
    return npz.open_lazily(path_of(folder, gap, backward=backward), "confidence")


def writer(folder: Path, gap: int, frames: int, size: tuple[int, int], *, backward: bool = False) -> npz.Rows:
    """Start the file of one gap for ``frames`` rows of (height, width) ``size`` in cells."""
    path, shape = path_of(folder, gap, backward=backward), (frames, *size)
    return npz.Rows(path, flow=((*shape, 2), np.float16), confidence=(shape, np.uint8))
