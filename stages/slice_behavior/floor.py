"""Keep the animal at home and on something: fill floor that nobody recorded, cut what lies beyond."""

from typing import cast

import numpy as np
from jaxtyping import Bool, UInt8
from scipy.ndimage import binary_dilation, label
from scipy.spatial import ConvexHull, Delaunay, QhullError

from pipeline.behavior.support import SUPPORTED, floor_level

FILLED = 3
"""Mark of allowed voxels right above floor that was filled."""
JOINS_VOXELS = 3
"""Gaps in the seen floor that are no wider than twice this belong to the same home."""
MARGIN_VOXELS = 1
"""The home goes on this far beyond the outermost seen floor: half a voxel and the error of the map."""


def with_filled_floor(
    marks: UInt8[np.ndarray, "x y z"],
    occupancy: UInt8[np.ndarray, "x y z"],
    visited: Bool[np.ndarray, "x y z"],
) -> UInt8[np.ndarray, "x y z"]:
    """Return the marks of where the root may be with a floor beneath all of them, and none outside of the
    home.

    ``marks`` has 1 where the root may be and 2 right above something solid. The home is the convex hull of
    the largest connected part of the seen floor and of all places that were visited. Columns in it that the
    root may be in and that nothing carries get `FILLED` at the level of the floor; those where furniture
    stands instead are left out. Unchanged where no floor was seen.
    """
    level = floor_level(marks == SUPPORTED)
    if level is None:
        return marks
    floor = (marks == SUPPORTED)[:, max(level - 1, 0) : level + 2].any(1)
    home = hull(connected(floor) | visited.any(1))
    masked = np.where(home[:, None], marks, 0)
    carried, solid = masked >= SUPPORTED, occupancy == 1
    unsupported = (masked > 0).any(1) & ~carried[:, : level + 2].any(1) & ~solid[:, : level + 2].any(1)
    # under a seat that nobody saw from below there is no floor
    unsupported &= (masked[:, level] > 0) | ~carried.any(1)
    masked[:, level][unsupported] = FILLED
    carried = np.any(masked >= SUPPORTED, axis=1, keepdims=True)
    masked[np.broadcast_to(~carried, masked.shape)] = 0
    return masked


def connected(floor: Bool[np.ndarray, "x z"]) -> Bool[np.ndarray, "x z"]:
    """Return the largest part of the floor that hangs together, over gaps of twice `JOINS_VOXELS`."""
    grown = binary_dilation(floor, iterations=JOINS_VOXELS)
    part, _ = cast("tuple[np.ndarray, int]", label(grown))
    largest = np.bincount(part[floor], minlength=1)
    return floor & (part == largest.argmax())


def hull(columns: Bool[np.ndarray, "x z"]) -> Bool[np.ndarray, "x z"]:
    """Return the columns within the convex hull of some, and `MARGIN_VOXELS` around it."""
    corners = np.argwhere(columns).astype(float)
    every = np.argwhere(np.ones_like(columns))
    try:
        inside = Delaunay(corners[ConvexHull(corners).vertices]).find_simplex(every) >= 0
    except QhullError:  # on one line, or fewer than three
        return binary_dilation(columns, iterations=MARGIN_VOXELS)
    return binary_dilation(inside.reshape(columns.shape), iterations=MARGIN_VOXELS)
