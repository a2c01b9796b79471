"""The scene around a motion: its signed distance, and points of its surface as PointNet reads them.

`MotionScene` is a part of a mesh; `MotionScene.around` draws the points near any frame, in that frame.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Float

from pipeline.behavior.trajectories import Trajectory
from pipeline.data import ply
from pipeline.geometry import rigid, signed_distance
from pipeline.geometry.meshes import Mesh
from pipeline.geometry.signed_distance import SignedDistance, SurfacePoints

SPACING_M = 0.07
VERTICAL_SURFACE = 0.7
"""A surface whose normal has a smaller vertical part stands; half of the points are drawn from such."""
MARGIN_M = 0.15
"""Distances are known this far beyond the mesh."""
LEVEL_SURFACE = 0.9
"""A surface whose normal has a larger vertical part lies."""
BIN_M, FLOOR_BAND_M = 0.02, 0.03
"""Levels are counted in bins of this size; the floor is the median of what lies this close to its bin."""


@dataclass(frozen=True)
class MotionScene:
    """A still surface between two corners of a box, ready to be asked."""

    mesh: Mesh
    low: Float[np.ndarray, "3"]
    high: Float[np.ndarray, "3"]
    """world frame"""
    voxel_m: float = 0.04
    known: SignedDistance | None = None
    """distances in that part, where the scan came with them"""

    @classmethod
    def for_motion(
        cls, mesh: Mesh, roots_world: Float[np.ndarray, "frame 3"], reach_m: float = 0.7
    ) -> "MotionScene":
        """Take the whole breadth of a mesh, at the heights where a body has been."""
        low, high = np.asarray(mesh.vertices).min(0) - MARGIN_M, np.asarray(mesh.vertices).max(0) + MARGIN_M
        low[1] = max(low[1], roots_world[:, 1].min() - reach_m)
        high[1] = min(high[1], roots_world[:, 1].max() + reach_m)
        return cls(mesh, low, high)

    @classmethod
    def reconstructed(cls, reconstruction: Path, tracks: Iterable[Trajectory]) -> "MotionScene":
        """Read `scene.ply` at the heights where the reconstructed animal has been."""
        roots = np.concatenate([track.world_from_agent[track.valid, :3, 3] for track in tracks])
        return cls.for_motion(ply.read_ply(reconstruction / "scene.ply"), roots)

    @cached_property
    def distance(self) -> SignedDistance:
        """The signed distance in that part; measured when first asked for, where it is not known."""
        return self.known or signed_distance.from_mesh(self.mesh, self.low, self.high, voxel_m=self.voxel_m)

    @cached_property
    def surface(self) -> SurfacePoints:
        """Points of the surface in that part."""
        points = signed_distance.surface_points(self.mesh, SPACING_M)
        inside = ((points.points > self.low) & (points.points < self.high)).all(1)
        return SurfacePoints(points.points[inside], points.normals[inside])

    @property
    def floor_m(self) -> float:
        """Height of the floor: the lowest level with a fair share of the surface that lies facing up."""
        level = self.surface.points[self.surface.normals[:, 1] > LEVEL_SURFACE, 1]
        if not len(level):
            return float(self.surface.points[:, 1].min())
        count, edges = np.histogram(level, np.arange(level.min() - BIN_M, level.max() + 3 * BIN_M, BIN_M))
        lowest = edges[np.flatnonzero(count > 0.25 * count.max())[0]] + BIN_M / 2
        return float(np.median(level[np.abs(level - lowest) < FLOOR_BAND_M]))

    def around(
        self,
        world_from_frame: Float[np.ndarray, "batch 4 4"],
        centre_world: Float[np.ndarray, "batch 3"],
        reach_m: float,
        count: int,
        rng: np.random.Generator,
    ) -> Float[np.ndarray, "batch point 3"]:
        """Draw points within ``reach_m`` of each centre, in the given frames; zeros where there are none."""
        points = self.surface.points.astype(np.float32)
        standing = np.abs(self.surface.normals[:, 1]) < VERTICAL_SURFACE
        frame_from_world = rigid.inverse(world_from_frame)
        drawn = np.zeros((len(centre_world), count, 3), np.float32)
        if not count:
            return drawn
        for row, centre in enumerate(np.asarray(centre_world, np.float32)):
            near = np.flatnonzero(((points - centre) ** 2).sum(1) < reach_m**2)
            if not len(near):
                continue
            upright = near[standing[near]]
            first = rng.choice(upright, count // 2) if len(upright) else near[:0]
            index = np.concatenate([first, rng.choice(near, count - len(first))])
            drawn[row] = rigid.apply(frame_from_world[row], points[index])
        return drawn
