"""The depth of an animal that one picture shows: it stands where its lowest pixels touch the map.

A body is a box for this: a face that rises from the line of contact towards the camera, and a level back.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from pipeline.geometry import cameras
from pipeline.geometry.meshes import RayCaster

LOWEST_SHARE = 0.03
"""Share of a mask's pixels, from below, that are as likely shadow and soft outline as paws: where the others
end, the animal stands."""
LEVEL_COSINE = 0.8
"""Surface that carries is level above this cosine of its slope."""
BORDER_PX = 2
"""A mask that comes so near to the picture's lower border may go on beyond it, pixels."""
MIN_AREA_PX = 12


@dataclass(frozen=True)
class Contact:
    """Where something stands."""

    point_world: Float[np.ndarray, "3"]
    certain: bool
    """False where its lowest part is hidden, beyond the picture or before something upright."""


def find(
    mask: Bool[np.ndarray, "height width"],
    intrinsics: Float[np.ndarray, "3 3"],
    world_from_camera: Float[np.ndarray, "4 4"],
    caster: RayCaster,
) -> Contact | None:
    """Find where the lowest pixels of a mask touch the surface; None where they meet none."""
    rows, columns = np.nonzero(mask)
    if len(rows) < MIN_AREA_PX:
        return None
    lowest = float(np.quantile(rows, 1 - LOWEST_SHARE))
    pixel = np.array([np.median(columns[rows >= lowest]) + 0.5, lowest + 1.0])
    ray = cameras.unproject(pixel, intrinsics) @ world_from_camera[:3, :3].T
    hit = caster.cast(world_from_camera[:3, 3], ray[None])
    if hit.face[0] < 0:
        return None
    corner = caster.mesh.vertices[caster.mesh.faces[hit.face[0]]]
    normal = np.cross(corner[1] - corner[0], corner[2] - corner[0])
    level = abs(normal[1]) > LEVEL_COSINE * max(float(np.linalg.norm(normal)), 1e-12)
    inside = rows.max() < mask.shape[0] - BORDER_PX
    return Contact(world_from_camera[:3, 3] + ray * hit.distance[0], bool(level and inside))


def depth_of(
    mask: Bool[np.ndarray, "height width"],
    point_world: Float[np.ndarray, "3"],
    back_m: float,
    intrinsics: Float[np.ndarray, "3 3"],
    world_from_camera: Float[np.ndarray, "4 4"],
) -> Float[np.ndarray, "height width"]:
    """Return the depth of a body that stands at a point, its back ``back_m`` above, inside a mask; 0 outside
    and where no ray meets it. Metres, world +y up."""
    rows, columns = np.nonzero(mask)
    eye = world_from_camera[:3, 3]
    rays = (
        cameras.unproject(np.stack([columns, rows], axis=1) + 0.5, intrinsics) @ world_from_camera[:3, :3].T
    )
    towards = (eye - point_world) * [1, 0, 1]
    towards /= max(float(np.linalg.norm(towards)), 1e-6)
    facing = rays @ towards
    z = ((point_world - eye) @ towards) / np.where(facing < -1e-6, facing, np.nan)
    height = eye[1] + z * rays[:, 1] - point_world[1]
    above = point_world[1] + back_m - eye[1]
    over = above / np.where(rays[:, 1] < -1e-6, rays[:, 1], np.nan)
    z = np.where((height > back_m) & (above < 0) & np.isfinite(over), over, z)
    depth = np.zeros(mask.shape, np.float32)
    depth[rows, columns] = np.where(np.isfinite(z) & (z > 0), z, 0)
    return depth


def between(
    timestamp_s: Float[np.ndarray, "frame"], found: list[Contact | None], max_s: float
) -> Float[np.ndarray, "frame 3"]:
    """Return the contact of each frame; where it is not certain, one interpolated between certain ones at
    most ``max_s`` away, NaN where there is none."""
    certain = np.array([frame for frame, each in enumerate(found) if each is not None and each.certain], int)
    points = np.full((len(found), 3), np.nan)
    if not len(certain):
        return points
    known = np.stack([found[frame].point_world for frame in certain])
    for axis in range(3):
        points[:, axis] = np.interp(timestamp_s, timestamp_s[certain], known[:, axis])
    points[np.abs(timestamp_s[:, None] - timestamp_s[certain]).min(1) > max_s] = np.nan
    return points
