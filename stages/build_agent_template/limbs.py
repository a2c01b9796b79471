"""Limbs that moved while the phone circled the animal: a swinging tail is carved away when all frames count.

Points measured off the still body show where such a limb has been. The place far out where most frames saw it
selects the frames in which it stood alike, and there only these are fused.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from pipeline.geometry.tsdf import Volume

BESIDE_M = 0.025
"""measured points this far from the still body belong to what moved"""
FARTHEST_M = 0.35
"""unless they lie farther away than this"""
LOWEST_M = 0.02
"""or nearer to the ground than this"""
ALIKE_M = 0.03
"""frames are alike that saw the limb within this of one place"""
LEAST_POINTS, LEAST_FRAMES = 3, 12
"""with at least so many points; fewer alike frames do not determine its shape"""
AROUND_M = 0.03
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
) -> Limb | None:
    """Find what moved among the points measured on the animal in each frame; None when (nearly) all stood
    still.
    """
    body = KDTree(inside_world)
    off_body = {}
    for frame, points in points_world.items():
        away, _ = body.query(points, distance_upper_bound=FARTHEST_M)
        off_body[frame] = (away > BESIDE_M) & np.isfinite(away) & (above_ground_m[frame] > LOWEST_M)
    points = np.concatenate([points_world[frame][moved] for frame, moved in off_body.items()])
    frame = np.concatenate([np.full(moved.sum(), frame) for frame, moved in off_body.items()])
    if not len(points):
        return None
    place = _common_place(points, frame, body.query(points)[0])
    seen, count = np.unique(frame[np.linalg.norm(points - place, axis=1) < ALIKE_M], return_counts=True)
    matching = seen[count >= LEAST_POINTS]
    return Limb(matching, points) if len(matching) >= LEAST_FRAMES else None


def _common_place(
    points: Float[np.ndarray, "point 3"], frame: Int[np.ndarray, "point"], away_m: Float[np.ndarray, "point"]
) -> Float[np.ndarray, "3"]:
    """Return the place that many frames saw, far out: the most frames times distance from the body."""
    _, cell = np.unique(np.floor(points / ALIKE_M).astype(int), axis=0, return_inverse=True)
    cell = cell.ravel()
    frames = np.bincount(np.unique(np.stack([cell, frame]), axis=1)[0])
    away = np.bincount(cell, away_m) / np.bincount(cell)
    place = points[cell == (frames * away).argmax()].mean(0)
    for _ in range(3):
        place = points[np.linalg.norm(points - place, axis=1) < ALIKE_M].mean(0)
    return place


def space_of(limb: Limb, volume: Volume) -> Bool[np.ndarray, "x y z"]:
    """Return which cells of a volume lie near where the limb has been."""
    axes = [volume.origin[axis] + np.arange(volume.weight.shape[axis]) * volume.voxel_m for axis in range(3)]
    cells = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    return np.isfinite(KDTree(limb.points_world).query(cells, distance_upper_bound=AROUND_M)[0])
