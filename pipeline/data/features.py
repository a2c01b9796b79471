"""Dense descriptors of one recording as files: `features/<id>/features.npz`, mapped lazily."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from pipeline.data import npz
from pipeline.data.schema import FileSchema

STRIDE_PX = 8
"""stride of the descriptor grid, color pixels"""
CHANNELS = 16
"""channels of a descriptor after projection to the shared basis"""
BASIS = FileSchema.of(
    "feature_basis/basis.npz",
    "mean [channel] f4",
    "components [16 channel] f4",
    "scale [] f4",
    "explained [16] f4",
)
FEATURES = FileSchema.of("features/features.npz", "features [frame height width 16] f2")


def open_features(folder: Path) -> Float[np.ndarray, "frame height width 16"]:
    """Map the L2-normalized descriptors of a finished `features/<id>`."""
    return npz.open_lazily(folder / "features.npz", "features")


def writer(folder: Path, frames: int, color_size: tuple[int, int]) -> npz.Rows:
    """Begin `features.npz` for ``frames`` pictures of (height, width) ``color_size``; rows are appended."""
    shape = (frames, *(side // STRIDE_PX for side in color_size), CHANNELS)
    return npz.Rows(folder / "features.npz", features=(shape, np.float16))
