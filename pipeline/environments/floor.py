"""Walkable floor for a person: columns observed between shin and head height without solid voxels."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from pipeline.behavior.perception import FeatureVolume

SHIN_M, HEAD_M = 0.3, 1.6
"""Heights above the floor between which solid voxels stop a person."""
CELLS, CELL_M = 16, 0.25
"""Cells along each side of an observed occupancy map, and the side of a cell in meters."""


@dataclass(frozen=True)
class PersonFloor:
    """Free and blocked columns of one scene, seen from above."""

    blocked: Bool[np.ndarray, "x z"]
    """True where a person cannot stand."""
    corner: Float[np.ndarray, "2"]
    """World x and z where column 0 begins, meters."""
    cell_m: float
    floor_m: float
    """World height of the floor, meters."""

    @classmethod
    def of(cls, volume: FeatureVolume, roots_world: Float[np.ndarray, "frame 3"]) -> "PersonFloor":
        """Find the floor, the level below the animal with the most solid voxels; unseen is blocked."""
        solid = volume.occupancy == 1
        height = volume.origin[1] + (np.arange(solid.shape[1]) + 1) * volume.voxel_m
        below = height <= np.percentile(roots_world[:, 1], 5)
        count = np.where(below, solid.sum((0, 2)), 0)
        floor_m = float(height[count.argmax()]) if count.any() else float(roots_world[:, 1].min())
        above = (height > floor_m + SHIN_M) & (height <= floor_m + HEAD_M)
        seen = volume.occupancy[:, above]
        blocked = (seen == 1).any(1) | ((seen != 0).all(1) & above.any())
        return cls(blocked, volume.origin[[0, 2]], volume.voxel_m, floor_m)

    def blocks(self, points: Float[np.ndarray, "*batch 2"]) -> Bool[np.ndarray, "*batch"]:
        """Return which world points (x, z; meters) are blocked or outside; none without a scene."""
        if self.blocked.size == 1:
            return np.zeros(points.shape[:-1], bool)
        index = np.floor((points - self.corner) / self.cell_m).astype(int)
        last = np.array(self.blocked.shape) - 1
        inside = ((index >= 0) & (index <= last)).all(-1)
        index = np.clip(index, 0, last)
        return ~inside | self.blocked[index[..., 0], index[..., 1]]

    def around(
        self, position: Float[np.ndarray, "person 2"], heading: Float[np.ndarray, "person"]
    ) -> Float[np.ndarray, "person 16 16"]:
        """Return occupancy (1 blocked) around persons, in their own frames: first axis left, second ahead."""
        axis = (np.arange(CELLS) + 0.5 - CELLS / 2) * CELL_M
        left, ahead = np.meshgrid(axis, axis, indexing="ij")
        local = np.stack([left, ahead], axis=-1).reshape(1, -1, 2)
        points = position[:, None] + to_world(local, heading[:, None])
        return self.blocks(points).reshape(-1, CELLS, CELLS).astype(np.float32)


def to_world(
    local: Float[np.ndarray, "*#batch 2"], heading: Float[np.ndarray, "*#batch"]
) -> Float[np.ndarray, "*#batch 2"]:
    """Rotate vectors (left, ahead) by headings about world +y (0 is +z) into world x and z."""
    cosine, sine = np.cos(heading), np.sin(heading)
    left, ahead = local[..., 0], local[..., 1]
    return np.stack([cosine * left + sine * ahead, -sine * left + cosine * ahead], axis=-1)


def to_local(
    world: Float[np.ndarray, "*#batch 2"], heading: Float[np.ndarray, "*#batch"]
) -> Float[np.ndarray, "*#batch 2"]:
    """Undo `to_world`."""
    return to_world(world, -heading)
