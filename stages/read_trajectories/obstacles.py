"""An obstacle map as a feature volume: floor, obstacles, and free space around where the animal went."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from pipeline.behavior.perception import FeatureVolume
from pipeline.core.errors import InputError
from stages.read_trajectories.tables import columns, numbers

CHANNELS = 16
FLOOR, OBSTACLE = 0, 1
"""Channels with value 1 in voxels of the floor and of obstacles."""
MARGIN_M = 1.0
HEADROOM_M = 1.0
OBSTACLE_TOP_M = 1.0
"""Default height of obstacles, meters above the floor: that of furniture."""
MAX_VOXELS = 10_000_000


def no_scene() -> FeatureVolume:
    """Return a volume of a single unknown voxel."""
    features, unseen = np.zeros((CHANNELS, 1, 1, 1), np.float16), np.full((1, 1, 1), 2, np.uint8)
    return FeatureVolume(features, unseen, np.zeros(3), 0.1)


def volume_from_csv(path: Path, visited: Float[np.ndarray, "frame 3"], cell_m: float) -> FeatureVolume:
    """Read occupied cells (x, z, optionally bottom and top; meters). Raises TRJ-001 as `columns` does."""
    table = columns(path, ("x", "z"))
    x, z = numbers(path, table, "x"), numbers(path, table, "z")
    if not (np.isfinite(x).all() and np.isfinite(z).all()):
        remedy = "give both of every occupied cell, meters"
        raise InputError("TRJ-001", "has cells without x or z", str(path), remedy)
    floor = float(np.nanmin(visited[:, 1])) if len(visited) else 0.0
    floor = 0.0 if 0.0 <= floor < HEADROOM_M else floor
    heights = {
        name: numbers(path, table, name) if name in table else np.full(len(x), np.nan)
        for name in ("bottom", "top")
    }
    bottom = np.where(np.isfinite(heights["bottom"]), heights["bottom"], floor)
    top = np.where(np.isfinite(heights["top"]), heights["top"], floor + OBSTACLE_TOP_M)
    corners = np.concatenate([np.stack([x, bottom, z], -1), np.stack([x, top, z], -1), visited])
    around = np.array([MARGIN_M, 0.0, MARGIN_M])
    low = np.floor((np.nanmin(corners, axis=0) - around) / cell_m) * cell_m
    low[1] = floor - 2 * cell_m
    high = np.nanmax(corners, axis=0) + around + [0.0, HEADROOM_M, 0.0]
    size = np.ceil((high - low) / cell_m)
    if size.prod() > MAX_VOXELS:
        span = " x ".join(f"{meters:g}" for meters in high - low)
        what = f"tracks and obstacles span {span} m, too much for cells of {cell_m:g} m"
        raise InputError("TRJ-001", what, str(path), "write meters; or set cell_m in the recipe")
    shape = size.astype(int)
    kind = np.full(shape, -1)
    kind[:, :2] = FLOOR
    column = np.floor((np.stack([x, z], -1) - low[[0, 2]]) / cell_m).astype(int)
    span = np.round((np.stack([bottom, top], -1) - low[1]) / cell_m).astype(int)
    for (i, k), (first, last) in zip(column, span, strict=True):
        kind[i, max(first, 0) : max(last, first + 1), k] = OBSTACLE
    features = np.stack([kind == channel for channel in range(CHANNELS)]).astype(np.float16)
    return FeatureVolume(features, (kind >= 0).astype(np.uint8), low, cell_m)
