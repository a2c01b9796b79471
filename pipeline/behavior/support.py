"""Supporting surfaces: tops of solid voxels, and the height of an animal's root above them.

If samples are off by a tenth of a meter, an animal floats or sinks. `Support.heights` clamps roots to the
recorded height range above the nearest top; `smoothed_jumps` turns steps between tops into jumps.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, UInt8

from pipeline.behavior.perception import FeatureVolume

SUPPORTED = 2
"""mark of allowed voxels right above solid ones; 3 above filled floor, 1 for other allowed voxels"""
HEIGHT_TAIL_PERCENT = (1.0, 5.0)
"""percentage of frames below, and above, the height range: at rest, and in motion, which includes jumps"""
MIN_SUPPORTED_SHARE = 0.5
"""minimum share of frames above something solid"""
FLOOR_SHARE = 0.25
"""The floor is the lowest level with this share of the columns of the level that most columns have, or the
one above, if more columns have it: noise of the map."""
JUMP_KERNEL = np.array([1.0, 2.0, 3.0, 2.0, 1.0]) / 9
"""smoothing kernel over 0.5 s that turns a step into a jump"""


@dataclass(frozen=True)
class Support:
    """Supporting surfaces of one scene, and the range of the root's height above them."""

    tops: Float[np.ndarray, "x z level"]
    """world heights of the tops of each column, ascending, padded with infinity"""
    corner: Float[np.ndarray, "2"]
    """world x and z where column 0 begins"""
    voxel_m: float
    range_m: Float[np.ndarray, "2 2"]
    """lowest and highest root above a top, at rest (0) and in motion (1)"""

    @classmethod
    def of(
        cls, volume: FeatureVolume, marks: UInt8[np.ndarray, "x y z"], range_m: Float[np.ndarray, "2 2"]
    ) -> "Support | None":
        """Find the tops of a scene; None if supports or heights are unknown."""
        supported = marks >= SUPPORTED
        if not supported.any() or not np.isfinite(range_m).all():
            return None
        level = np.where(supported, np.arange(marks.shape[1])[:, None], np.inf)
        levels = np.sort(level, axis=1)[:, : int(supported.sum(1).max())]
        tops = volume.origin[1] + np.swapaxes(levels, 1, 2) * volume.voxel_m
        return cls(tops, np.asarray(volume.origin)[[0, 2]], volume.voxel_m, np.asarray(range_m, float))

    def heights(
        self, points_world: Float[np.ndarray, "*batch 3"], moves: Bool[np.ndarray, "*batch"]
    ) -> Float[np.ndarray, "*batch"]:
        """Return the nearest heights within the range above a top; unchanged where nothing supports."""
        column = np.floor((points_world[..., [0, 2]] - self.corner) / self.voxel_m).astype(int)
        inside = ((column >= 0) & (column < self.tops.shape[:2])).all(-1)
        column = np.clip(column, 0, np.array(self.tops.shape[:2]) - 1)
        tops, own = self.tops[column[..., 0], column[..., 1]], points_world[..., 1]
        low, high = np.moveaxis(self.range_m[moves.astype(int)], -1, 0)
        possible = np.clip(own[..., None], tops + low[..., None], tops + high[..., None])
        nearest = np.abs(possible - own[..., None]).argmin(-1)
        found = np.take_along_axis(possible, nearest[..., None], axis=-1)[..., 0]
        return np.where(inside & np.isfinite(found), found, own)


def mark_supported(
    allowed: Bool[np.ndarray, "x y z"], occupancy: UInt8[np.ndarray, "x y z"]
) -> UInt8[np.ndarray, "x y z"]:
    """Return 1 where the root may be, and 2 where that is right above something solid."""
    beneath = np.zeros_like(allowed)
    beneath[:, 1:] = occupancy[:, :-1] == 1
    return allowed.astype(np.uint8) + (allowed & beneath & (occupancy != 1))


def with_headroom(
    marks: UInt8[np.ndarray, "x y z"], voxel_m: float, range_m: Float[np.ndarray, "2 2"]
) -> UInt8[np.ndarray, "x y z"]:
    """Return the marks with supports only where the root may be at its lowest height (`Support.range_m`)
    above them, and nothing allowed in columns without supports. Unchanged if heights are unknown.
    """
    lowest = range_m[:, 0].min()
    if not np.isfinite(lowest):
        return marks
    above = max(int(lowest / voxel_m), 0)
    fits = np.zeros(marks.shape, bool)
    fits[:, : marks.shape[1] - above] = marks[:, above:] > 0
    marks = np.where((marks >= SUPPORTED) & ~fits, 1, marks).astype(np.uint8)
    return marks * (marks >= SUPPORTED).any(1, keepdims=True)


def floor_level(supported: Bool[np.ndarray, "x y z"]) -> int | None:
    """Return the index along y of the voxels right above the floor; None without supports."""
    count = supported.sum((0, 2))
    if not count.any():
        return None
    lowest = int(np.flatnonzero(count >= FLOOR_SHARE * count.max())[0])
    return lowest + int(count[lowest : lowest + 2].argmax())


def level_beneath(
    volume: FeatureVolume, marks: UInt8[np.ndarray, "x y z"], points_world: Float[np.ndarray, "point 3"]
) -> Float[np.ndarray, "point"]:
    """Return the index along y of the highest supported voxel not above each point; -infinity without one."""
    voxel, inside = volume.voxel(points_world)
    column, number = marks[voxel[:, 0], :, voxel[:, 2]] >= SUPPORTED, np.arange(marks.shape[1])
    level = np.where(column & (number <= voxel[:, 1:2]), number, -np.inf).max(1)
    return np.where(inside, level, -np.inf)


Stay = tuple[
    FeatureVolume, UInt8[np.ndarray, "x y z"], Float[np.ndarray, "frame 3"], Bool[np.ndarray, "frame"]
]
"""A scene, its marks, root positions in it, and whether the animal moves there"""


def height_ranges(stays: Iterable[Stay]) -> Float[np.ndarray, "2 2"]:
    """Return `Support.range_m` of some stays; NaN if unknown."""
    above, moved = [np.zeros(0)], [np.zeros(0, bool)]
    for volume, marks, points, moves in stays:
        level = level_beneath(volume, marks, points)
        above.append(points[:, 1] - volume.origin[1] - level * volume.voxel_m)
        moved.append(moves)
    height, moves = np.concatenate(above), np.concatenate(moved)
    known = np.isfinite(height)
    if known.sum() <= MIN_SUPPORTED_SHARE * len(known):
        return np.full((2, 2), np.nan)
    some = (known & kind if (known & kind).any() else known for kind in (~moves, moves))
    both = zip(some, HEIGHT_TAIL_PERCENT, strict=True)
    return np.array([np.percentile(height[part], [rare, 100 - rare]) for part, rare in both])


def smoothed_jumps(
    height: Float[np.ndarray, "*batch frame"], before: Float[np.ndarray, "*batch"]
) -> Float[np.ndarray, "*batch frame"]:
    """Turn steps into jumps: the maximum of heights and their average over half a second."""
    reach = len(JUMP_KERNEL) // 2
    first, last = np.repeat(before[..., None], reach, -1), np.repeat(height[..., -1:], reach, -1)
    padded = np.concatenate([first, height, last], axis=-1)
    windows = np.lib.stride_tricks.sliding_window_view(padded, len(JUMP_KERNEL), axis=-1)
    return np.maximum(height, windows @ JUMP_KERNEL)
