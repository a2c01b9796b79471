"""The artifact `frames` with given pictures, for tests of stages that need neither lens nor poses."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pipeline.data import images, npz


def write_frames(folder: Path, pictures: Sequence[np.ndarray], depth: np.ndarray, **known: object) -> None:
    """Write RGB pictures at 10 Hz, each with the same certain depth (meters).

    ``known`` are arrays of `frames.npz` that differ from unit lenses, an upright phone and full quality.
    """
    for name in ("color", "depth", "confidence"):
        (folder / name).mkdir(parents=True)
    for frame, picture in enumerate(pictures):
        images.write_color(folder / f"color/{frame:06d}.jpg", picture)
        images.write_depth(folder / f"depth/{frame:06d}.exr", depth)
        images.write_gray(folder / f"confidence/{frame:06d}.png", np.full(depth.shape, 2, np.uint8))
    count, lens = len(pictures), np.tile(np.eye(3), (len(pictures), 1, 1))
    table = {"timestamp_s": np.arange(count) / 10, "intrinsics": lens, "depth_intrinsics": lens}
    table |= {"gravity_known": np.array(True), "quality": np.ones(count, np.float32)}
    npz.save(folder / "frames.npz", **table | known)
