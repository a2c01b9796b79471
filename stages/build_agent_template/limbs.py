"""Limbs that moved while the phone went round: a tail that swings is carved away when all frames judge together.

What is measured beside the still body tells where such a limb has been. The place far out where most frames saw it
chooses the frames in which it stood alike, and there these alone say what is solid.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree

from pipeline.space.tsdf import Volume


@dataclass(frozen=True)
class Moving:
    """How limbs that moved are found."""

    beside_m: float = 0.025
    """a measured point this far from the still body belongs to what moved"""
    farthest_m: float = 0.35
    """unless it lies farther away than this"""
    lowest_m: float = 0.02
    """or nearer to the ground than this"""
    alike_m: float = 0.03
    """frames are alike that saw the limb within this of one place"""
    least_points: int = 3
    """with at least so many points"""
    least_frames: int = 12
    """fewer alike frames cannot tell its shape"""
    around_m: float = 0.03
    """the limb's space reaches this far around all that was measured of it"""


@dataclass(frozen=True)
class Limb:
    """Where a limb has been, and when it stood alike."""

    frames: Int[np.ndarray, "alike"]
    points_world: Float[np.ndarray, "point 3"]
    """measured on it in all frames"""


def find_limb(
    points_world: Mapping[int, Float[np.ndarray, "point 3"]],
    above_ground_m: Mapping[int, Float[np.ndarray, "point"]],
    inside_world: Float[np.ndarray, "cell 3"],
    options: Moving,
) -> Limb | None:
    """Find what moved among the points measured on the animal in each frame; None when (nearly) all stood still."""
    body = cKDTree(inside_world)
    found = {}
    for frame, points in points_world.items():
        away, _ = body.query(points, distance_upper_bound=options.farthest_m)
        found[frame] = (away > options.beside_m) & np.isfinite(away) & (above_ground_m[frame] > options.lowest_m)
    points = np.concatenate([points_world[frame][beside] for frame, beside in found.items()])
    frame = np.concatenate([np.full(beside.sum(), frame) for frame, beside in found.items()])
    if not len(points):
        return None
    place = _common_place(points, frame, body.query(points)[0], options.alike_m)
    seen, count = np.unique(frame[np.linalg.norm(points - place, axis=1) < options.alike_m], return_counts=True)
    alike = seen[count >= options.least_points]
    return Limb(alike, points) if len(alike) >= options.least_frames else None


def _common_place(
    points: Float[np.ndarray, "point 3"], frame: Int[np.ndarray, "point"], away_m: Float[np.ndarray, "point"], size_m: float
) -> Float[np.ndarray, "3"]:
    """Return the place that many frames saw, far out: the most frames times distance from the body."""
    _, cell = np.unique(np.floor(points / size_m).astype(int), axis=0, return_inverse=True)
    cell = cell.ravel()
    frames = np.bincount(np.unique(np.stack([cell, frame]), axis=1)[0])
    away = np.bincount(cell, away_m) / np.bincount(cell)
    place = points[cell == (frames * away).argmax()].mean(0)
    for _ in range(3):
        place = points[np.linalg.norm(points - place, axis=1) < size_m].mean(0)
    return place


def space_of(limb: Limb, volume: Volume, options: Moving) -> Bool[np.ndarray, "x y z"]:
    """Tell which cells of a volume lie near where the limb has been."""
    axes = [volume.origin[axis] + np.arange(volume.weight.shape[axis]) * volume.voxel_m for axis in range(3)]
    cells = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    return np.isfinite(cKDTree(limb.points_world).query(cells, distance_upper_bound=options.around_m)[0])
