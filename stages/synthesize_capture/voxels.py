"""A home as a feature volume, straight from its geometry: what `lives` gives in place of a reconstruction.

Each kind of thing has a code of its own, a unit vector that is the same in every home, as pictures' features
would be.
"""

import numpy as np
from jaxtyping import Float

from pipeline.behavior.perception import FeatureVolume
from stages.synthesize_capture.room import DEPTH_M, WIDTH_M, Room, Standing
from stages.synthesize_capture.sheets import Sheet

VOXEL_M = 0.1
MARGIN_M = 0.2
HEIGHT_M = 1.6
CHANNELS = 16
KINDS = (
    "floor", "wall", "window", "rug", "sofa", "shelf", "media", "cat tree", "coffee table", "dining table",
    "plant", "lamp", "bowls", "loose",
)  # fmt: skip
CODES = np.linalg.qr(np.random.default_rng(5).standard_normal((CHANNELS, CHANNELS)))[0][: len(KINDS)]
"""One orthonormal vector per kind."""
HEADROOM_M = 0.5
"""Free height above a place to rest."""


def volume_of(home: Room) -> FeatureVolume:
    """Voxelise floor, walls, surfaces and what they enclose."""
    origin = np.array([-WIDTH_M / 2 - MARGIN_M, -MARGIN_M, -DEPTH_M / 2 - MARGIN_M])
    extent = np.array([WIDTH_M, HEIGHT_M, DEPTH_M]) + 2 * MARGIN_M
    shape = tuple(np.ceil(extent / VOXEL_M - 1e-9).astype(int))
    centers = origin + (np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1) + 0.5) * VOXEL_M
    kind = np.full(shape, -1)
    outside = (np.abs(centers[..., 0]) > WIDTH_M / 2) | (np.abs(centers[..., 2]) > DEPTH_M / 2)
    kind[outside] = KINDS.index("wall")
    kind[centers[..., 1] < 0] = KINDS.index("floor")
    for thing in (*home.standing, *home.loose):
        kind[_taken(thing, centers, origin)] = KINDS.index(thing.name)
    for place in home.places:
        x, height, z = place.position
        if height > 0.1:
            near = np.hypot(centers[..., 0] - x, centers[..., 2] - z) < 0.3
            level = (centers[..., 1] > height + 0.05) & (centers[..., 1] < height + HEADROOM_M)
            kind[near & level] = -1
    codes = np.concatenate([CODES, np.zeros((1, CHANNELS))])
    features = np.moveaxis(codes[kind], -1, 0).astype(np.float16)
    return FeatureVolume(features, (kind >= 0).astype(np.uint8), origin, VOXEL_M)


def _taken(
    thing: Standing, centers: Float[np.ndarray, "x y z 3"], origin: Float[np.ndarray, "3"]
) -> np.ndarray:
    """Return a thing's voxels: surfaces above its clearance, and in its block all below the topmost one."""
    block = (thing.axis_distance(centers[..., 0], centers[..., 2]) < np.array(thing.piece.size) / 2).all(-1)
    if thing.name == "rug":  # colors the floor
        return block & (np.abs(centers[..., 1] + VOXEL_M / 2) < VOXEL_M / 2)
    if thing.name == "window":  # radiator and curtains hang on the wall
        return block & (centers[..., 1] > 0) & (centers[..., 1] < thing.piece.top)
    taken: np.ndarray = np.zeros(centers.shape[:3], bool)
    points = np.concatenate([surface_points(sheet) for sheet in thing.sheets()])
    index = np.floor((points[points[:, 1] > max(thing.piece.bottom, 0.01)] - origin) / VOXEL_M).astype(int)
    index = index[((index >= 0) & (index < taken.shape)).all(-1)]
    taken[tuple(index.T)] = True
    top = np.where(taken.any(1), taken.shape[1] - 1 - np.argmax(taken[:, ::-1], axis=1), -1)
    below = np.arange(taken.shape[1])[None, :, None] <= top[:, None]
    return taken | (block & below & (centers[..., 1] > max(thing.piece.bottom, 0.0)))


def surface_points(sheet: Sheet, spacing_m: float = 0.04) -> Float[np.ndarray, "point 3"]:
    """Return points on a sheet, at most about ``spacing_m`` apart."""
    points = np.asarray(sheet.points, float)
    for axis, length in zip((0, 1), sheet.size_m(), strict=True):
        count = max(int(np.ceil(length / spacing_m)) + 1, points.shape[axis])
        where = np.linspace(0, points.shape[axis] - 1, count)
        before = np.minimum(where.astype(int), points.shape[axis] - 2)
        share = (where - before).reshape([-1 if a == axis else 1 for a in range(3)])
        points = np.take(points, before, axis) * (1 - share) + np.take(points, before + 1, axis) * share
    return points.reshape(-1, 3)
