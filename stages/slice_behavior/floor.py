"""Supporting floor of the home: fill unseen floor, remove voxels outside of the home."""

from typing import cast

import numpy as np
from jaxtyping import Bool, Float, UInt8
from scipy.ndimage import binary_dilation, label
from scipy.spatial import ConvexHull, Delaunay, QhullError

from pipeline.behavior.perception import FeatureVolume
from pipeline.behavior.support import SUPPORTED, floor_level, level_beneath

FILLED = 3
"""Mark of allowed voxels right above floor that was filled."""
JOINS_VOXELS = 3
"""Gaps in the seen floor up to twice this wide are closed."""
MARGIN_VOXELS = 1
"""Margin of the home around the seen floor: half a voxel and the error of the map."""


def with_filled_floor(
    marks: UInt8[np.ndarray, "x y z"],
    occupancy: UInt8[np.ndarray, "x y z"],
    visited: Bool[np.ndarray, "x y z"],
) -> UInt8[np.ndarray, "x y z"]:
    """Return the marks of allowed voxels with floor beneath all of them, and none outside of the home.

    ``marks`` is 1 where the root may be and 2 right above solid voxels. The home is the convex hull of all
    visited places and of the connected part of the seen floor that they are on. Its allowed columns without
    support get `FILLED` at floor level, unless furniture is there. Unchanged if no floor was seen.
    """
    level = floor_level(marks == SUPPORTED)
    if level is None:
        return marks
    floor = (marks == SUPPORTED)[:, max(level - 1, 0) : level + 2].any(1)
    been = np.asarray(visited.any(1))
    home = hull(connected(floor, been) | been)
    masked = np.where(home[:, None], marks, 0)
    supported, solid = masked >= SUPPORTED, occupancy == 1
    unsupported = (masked > 0).any(1) & ~supported[:, : level + 2].any(1) & ~solid[:, : level + 2].any(1)
    # no floor is filled in under seats whose space below was not seen
    unsupported &= (masked[:, level] > 0) | ~supported.any(1)
    masked[:, level][unsupported] = FILLED
    return masked * (masked >= SUPPORTED).any(1, keepdims=True)


def with_level_floor(
    marks: UInt8[np.ndarray, "x y z"], volume: FeatureVolume, moving_world: Float[np.ndarray, "point 3"]
) -> UInt8[np.ndarray, "x y z"]:
    """Return the marks with all floor at one level.

    Near the boundary of two voxels a floor seems a voxel higher or lower in places. These are put on its
    level unless the moving animal's roots (world, meters) are higher or lower there: medians, half a voxel.
    """
    level = floor_level(marks >= SUPPORTED)
    if level is None:
        return marks
    marks, beneath, height_m = marks.copy(), level_beneath(volume, marks, moving_world), moving_world[:, 1]
    for other in (level - 1, level + 1):
        there, here = height_m[beneath == other], height_m[beneath == level]
        both = len(there) and len(here)
        if not both or abs(np.median(there) - np.median(here)) < volume.voxel_m / 2:
            put = marks[:, other] >= SUPPORTED
            marks[:, level][put], marks[:, other][put] = marks[:, other][put], 1
    return marks


def connected(floor: Bool[np.ndarray, "x z"], visited: Bool[np.ndarray, "x z"]) -> Bool[np.ndarray, "x z"]:
    """Return the connected component of the floor, across gaps of twice `JOINS_VOXELS`, with the most visited
    columns; the largest one if none was visited.
    """
    part, _ = cast("tuple[np.ndarray, int]", label(binary_dilation(floor | visited, iterations=JOINS_VOXELS)))
    count = np.bincount(part[floor], minlength=part.max() + 1)
    been = np.where(count > 0, np.bincount(part[visited], minlength=part.max() + 1), 0)
    return floor & (part == (been if been.any() else count).argmax())


def hull(columns: Bool[np.ndarray, "x z"]) -> Bool[np.ndarray, "x z"]:
    """Return the convex hull of columns, dilated by `MARGIN_VOXELS`."""
    corners = np.argwhere(columns).astype(float)
    every = np.argwhere(np.ones_like(columns))
    try:
        inside = Delaunay(corners[ConvexHull(corners).vertices]).find_simplex(every) >= 0
    except QhullError:  # collinear, or fewer than three
        return binary_dilation(columns, iterations=MARGIN_VOXELS)
    return binary_dilation(inside.reshape(columns.shape), iterations=MARGIN_VOXELS)
