"""Depth of an animal in a single picture, from the contact of its lowest pixels with the map.

The body is modeled as a box: a vertical face at the contact point towards the camera, and a level back.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float

from pipeline.geometry import cameras
from pipeline.geometry.meshes import Mesh, RayCaster, area_normals

LOWEST_SHARE = 0.03
"""Share of a mask's lowest pixels that is ignored as shadow or soft outline."""
LEVEL_COSINE = 0.8
"""Supporting surfaces have a slope with at least this cosine."""
BORDER_PX = 2
"""A mask this close to the picture's lower border may be cut off there, pixels."""
MIN_AREA_PX = 12


@dataclass(frozen=True)
class Contact:
    """The ground contact of an object."""

    point_world: Float[np.ndarray, "3"]
    certain: bool
    """False if its lowest part may be outside the picture, or is seen in front of a steep surface."""


@dataclass(frozen=True)
class StandingSurface:
    """The surface that animals stand on: the scene mesh, and the floor plane where it has holes."""

    caster: RayCaster
    floor_m: float

    def below(self, points_world: Float[np.ndarray, "point 3"]) -> Float[np.ndarray, "point"]:
        """Return the height of the first surface below each point, or of the floor, world y."""
        hits = self.caster.cast(points_world, np.broadcast_to([0.0, -1.0, 0.0], points_world.shape))
        return np.where(hits.face >= 0, points_world[:, 1] - hits.distance, self.floor_m)

    @cached_property
    def floor_alone(self) -> "StandingSurface":
        """The floor plane without what the map shows on it."""
        (left, _, front), (right, _, back) = (pick(self.caster.mesh.vertices, 0) for pick in (np.min, np.max))
        corners = [(x, self.floor_m, z) for x in (left, right) for z in (front, back)]
        mesh = Mesh(np.array(corners, np.float32), np.array([[0, 1, 2], [2, 1, 3]], np.int32))
        return StandingSurface(RayCaster(mesh), self.floor_m)


def find(
    mask: Bool[np.ndarray, "height width"],
    intrinsics: Float[np.ndarray, "3 3"],
    world_from_camera: Float[np.ndarray, "4 4"],
    standing: StandingSurface,
) -> Contact | None:
    """Find where the lowest pixels of a mask touch the surface; None if their ray misses it."""
    rows, columns = np.nonzero(mask)
    if len(rows) < MIN_AREA_PX:
        return None
    lowest = float(np.quantile(rows, 1 - LOWEST_SHARE))
    pixel = np.array([np.median(columns[rows >= lowest]) + 0.5, lowest + 1.0])
    ray = cameras.unproject(pixel, intrinsics) @ world_from_camera[:3, :3].T
    eye, inside = world_from_camera[:3, 3], rows.max() < mask.shape[0] - BORDER_PX
    for surface in (standing, standing.floor_alone):
        hit = surface.caster.cast(eye, ray[None])
        if hit.face[0] >= 0:
            normal = area_normals(surface.caster.mesh.vertices[surface.caster.mesh.faces[hit.face[0]]])
            level = abs(normal[1]) > LEVEL_COSINE * max(float(np.linalg.norm(normal)), 1e-12)
            return Contact(eye + ray * hit.distance[0], bool(level and inside))
    return None


def depth_of(
    mask: Bool[np.ndarray, "height width"],
    point_world: Float[np.ndarray, "3"],
    back_m: float,
    intrinsics: Float[np.ndarray, "3 3"],
    world_from_camera: Float[np.ndarray, "4 4"],
) -> Float[np.ndarray, "height width"]:
    """Return the depth of a body of height ``back_m`` at a contact point inside a mask; 0 outside the mask
    and where rays miss the body. Meters, world +y up."""
    rows, columns = np.nonzero(mask)
    eye = world_from_camera[:3, 3]
    rays = cameras.unproject(cameras.pixel_centers(rows, columns), intrinsics) @ world_from_camera[:3, :3].T
    towards = (eye - point_world) * [1, 0, 1]
    towards /= max(float(np.linalg.norm(towards)), 1e-6)
    facing = rays @ towards
    z = ((point_world - eye) @ towards) / np.where(facing < -1e-6, facing, np.nan)
    height = eye[1] + z * rays[:, 1] - point_world[1]
    above = point_world[1] + back_m - eye[1]
    over = above / np.where(rays[:, 1] < -1e-6, rays[:, 1], np.nan)
    on_back = ~(np.abs(height) <= back_m)  # also where a camera that looks down sees only the back
    z = np.where(on_back & (above < 0) & np.isfinite(over), over, z)
    depth = np.zeros(mask.shape, np.float32)
    depth[rows, columns] = np.where(np.isfinite(z) & (z > 0), z, 0)
    return depth


def between(
    timestamp_s: Float[np.ndarray, "frame"], found: list[Contact | None], max_s: float
) -> Float[np.ndarray, "frame 3"]:
    """Return the contact of each frame, interpolated between certain ones; NaN if none is in ``max_s``."""
    certain = np.array([frame for frame, each in enumerate(found) if each is not None and each.certain], int)
    points = np.full((len(found), 3), np.nan)
    if not len(certain):
        return points
    known = np.stack([found[frame].point_world for frame in certain])
    for axis in range(3):
        points[:, axis] = np.interp(timestamp_s, timestamp_s[certain], known[:, axis])
    points[np.abs(timestamp_s[:, None] - timestamp_s[certain]).min(1) > max_s] = np.nan
    return points
