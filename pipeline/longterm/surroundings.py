"""The scene around a motion: its signed distance, and surface points as input of PointNet."""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Float

from pipeline.behavior.trajectories import Trajectory
from pipeline.data import ply
from pipeline.geometry import rigid, signed_distance
from pipeline.geometry.ground import LEVEL_SURFACE, lowest_level
from pipeline.geometry.meshes import Mesh
from pipeline.geometry.signed_distance import SignedDistance, SurfacePoints

SPACING_M = 0.07
VERTICAL_SURFACE = 0.7
"""A surface whose normal has a smaller vertical component is steep; half of the points are sampled there."""
MARGIN_M = 0.15
"""Margin of the signed distance grid around the mesh."""


@dataclass(frozen=True)
class MotionScene:
    """The part of a static scene mesh in an axis-aligned box; its signed distance is computed lazily."""

    mesh: Mesh
    low: Float[np.ndarray, "3"]
    high: Float[np.ndarray, "3"]
    """world frame"""
    voxel_m: float = 0.04
    known: SignedDistance | None = None
    """signed distance in the box, if the scan came with one"""

    @classmethod
    def for_motion(
        cls, mesh: Mesh, roots_world: Float[np.ndarray, "frame 3"], reach_m: float = 0.7
    ) -> "MotionScene":
        """Take a mesh at full width, cropped to ``reach_m`` above and below the heights of the roots."""
        low, high = np.asarray(mesh.vertices).min(0) - MARGIN_M, np.asarray(mesh.vertices).max(0) + MARGIN_M
        low[1] = max(low[1], roots_world[:, 1].min() - reach_m)
        high[1] = min(high[1], roots_world[:, 1].max() + reach_m)
        return cls(mesh, low, high)

    @classmethod
    def reconstructed(cls, reconstruction: Path, tracks: Iterable[Trajectory]) -> "MotionScene":
        """Read `scene.ply`, cropped to the heights of the reconstructed animal."""
        roots = np.concatenate([track.world_from_agent[track.valid, :3, 3] for track in tracks])
        return cls.for_motion(ply.read_ply(reconstruction / "scene.ply"), roots)

    @cached_property
    def distance(self) -> SignedDistance:
        """The signed distance in the box."""
        return self.known or signed_distance.from_mesh(self.mesh, self.low, self.high, voxel_m=self.voxel_m)

    @cached_property
    def surface(self) -> SurfacePoints:
        """Points of the surface in the box."""
        points = signed_distance.surface_points(self.mesh, SPACING_M)
        inside = ((points.points > self.low) & (points.points < self.high)).all(1)
        return SurfacePoints(points.points[inside], points.normals[inside])

    @property
    def floor_m(self) -> float:
        """Height of the floor."""
        level = self.surface.points[self.surface.normals[:, 1] > LEVEL_SURFACE, 1]
        if not len(level):
            return float(self.surface.points[:, 1].min())
        return lowest_level(level, np.ones(len(level)))

    def around(
        self,
        world_from_frame: Float[np.ndarray, "batch 4 4"],
        center_world: Float[np.ndarray, "batch 3"],
        reach_m: float,
        count: int,
        rng: np.random.Generator,
    ) -> Float[np.ndarray, "batch point 3"]:
        """Sample points within ``reach_m`` of each center, in the given frames; zeros if there are none."""
        points = self.surface.points.astype(np.float32)
        standing = np.abs(self.surface.normals[:, 1]) < VERTICAL_SURFACE
        frame_from_world = rigid.inverse(world_from_frame)
        drawn = np.zeros((len(center_world), count, 3), np.float32)
        if not count:
            return drawn
        for row, center in enumerate(np.asarray(center_world, np.float32)):
            near = np.flatnonzero(((points - center) ** 2).sum(1) < reach_m**2)
            if not len(near):
                continue
            upright = near[standing[near]]
            first = rng.choice(upright, count // 2) if len(upright) else near[:0]
            index = np.concatenate([first, rng.choice(near, count - len(first))])
            drawn[row] = rigid.apply(frame_from_world[row], points[index])
        return drawn
