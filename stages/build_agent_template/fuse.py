"""Fuse masked depth into one closed surface.

Depth on the animal gives its surface; a pixel off the mask means that its ray is free up to the depth there
(`Silhouettes`). Voxels that hardly any frame sees through are inside the body; those below the ground are
outside. A swinging tail would be carved away: points measured off the static body locate such a limb
(`find_limb`), and there only frames with the same pose of it are fused.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import cast

import fast_simplification
import numpy as np
import scipy.ndimage
import trimesh
from jaxtyping import Bool, Float, Int, UInt8
from numba import njit
from scipy.spatial import KDTree
from skimage import measure

from pipeline.core.errors import InputError
from pipeline.data.clips import Clip, Masks
from pipeline.geometry import cameras, rigid
from pipeline.geometry.flying_pixels import supported
from pipeline.geometry.meshes import Mesh
from pipeline.geometry.tsdf import Volume, enclose
from stages.build_agent_template.poses import Turnaround, depth_labels

TRUNCATION_M = 0.03
"""truncation distance of the TSDF"""
MAX_FREE, MAX_FREE_FUSED = 0.08, 0.4
"""share of frames that see through a voxel above which it is carved, without and with fused depth"""
SMOOTH_VOXELS, SMOOTH_ROUNDS = 0.8, 6
"""standard deviation of the smoothing of the signed distance; rounds of Taubin smoothing of the surface"""
OUTLIER_FACTOR, OUTLIER_QUANTILE = 1.6, 0.98
"""outliers are farther from the middle than this factor times this quantile"""
MIN_DISTANCE = 0.05
"""least magnitude of the signed distance of voxels, in units of the truncation"""
MIN_CELLS = 200
"""least number of voxels of a body, a few for each of 25 bones"""
AGGRESSIVENESS = 4
"""aggressiveness of edge collapse: lower keeps shape better"""
OFF_BODY_M = 0.025
"""least distance of a moving limb's points from the static body"""
MAX_OFF_BODY_M = 0.35
"""and their largest distance from it"""
MIN_HEIGHT_M = 0.02
"""and their least height above ground"""
SAME_PLACE_M = 0.03
"""radius around one place within which frames must see the limb to have the same pose"""
MIN_POINTS, MIN_FRAMES = 3, 12
"""least points there per frame; least frames that determine the limb's shape"""
LIMB_MARGIN_M = 0.03
"""margin of the limb's region around its measured points"""


@dataclass(frozen=True)
class ClosedBody:
    """The animal's closed surface in the turnaround's world, and the voxels inside it."""

    mesh: Mesh
    inside_world: Float[np.ndarray, "cell 3"]
    voxel_m: float


@dataclass(frozen=True)
class Limb:
    """Where a limb has been, and the frames in which it has one pose."""

    frames: Int[np.ndarray, "chosen"]
    points_world: Float[np.ndarray, "point 3"]
    """measured on it in all frames, meters"""


class Silhouettes:
    """Per voxel, the number of frames that see it off the mask before the depth, and within the mask."""

    def __init__(self, origin: Float[np.ndarray, "3"], shape: tuple[int, int, int], voxel_m: float):
        self.origin, self.voxel_m = np.asarray(origin, float), voxel_m
        self.off_mask: Int[np.ndarray, "x y z"] = np.zeros(shape, np.int32)
        self.within: Int[np.ndarray, "x y z"] = np.zeros(shape, np.int32)

    def add(
        self,
        labels: UInt8[np.ndarray, "height width"],
        depth: Float[np.ndarray, "height width"],
        intrinsics: Float[np.ndarray, "3 3"],
        world_from_camera: Float[np.ndarray, "4 4"],
    ) -> None:
        """Count one frame (labels 255 animal, 0 not, 128 unknown); off the mask only before the depth."""
        camera_from_world = rigid.inverse(world_from_camera)
        start = camera_from_world[:3, :3] @ self.origin + camera_from_world[:3, 3]
        steps = np.ascontiguousarray(camera_from_world[:3, :3].T * self.voxel_m)
        depth = np.ascontiguousarray(depth, np.float32)
        _count(self.off_mask, self.within, start, steps, labels, depth, intrinsics)

    def share_off_mask(self) -> Float[np.ndarray, "x y z"]:
        """Return the share of frames that see a voxel off the mask; 0 where none sees it at all."""
        return self.off_mask / np.maximum(self.off_mask + self.within, 1)


def fuse(clip: Clip, masks: Masks, turnaround: Turnaround, voxel_m: float, vertices: int) -> ClosedBody:
    """Fuse and carve all frames that show the animal, then extract the largest closed surface.

    Where a limb moved, only frames with one pose of it count. Parts farther out, such as a tail's tip, move
    more, so this is repeated on the remaining frames.
    """
    frames = np.flatnonzero(masks.visible).tolist()
    points = {frame: _on_animal(clip, masks, turnaround, frame) for frame in frames}
    together = _without_outliers(np.concatenate(list(points.values())))
    volume = enclose(together, voxel_m=voxel_m, truncation_m=TRUNCATION_M)
    counts = _fuse_frames(clip, masks, turnaround, volume, points)
    off_mask, below = counts.share_off_mask(), _below_ground(volume, turnaround)
    body = extract(volume, off_mask, below, vertices)
    above = {frame: turnaround.ground.above(each) for frame, each in points.items()}
    while (limb := find_limb(points, above, body.inside_world)) and len(limb.frames) < len(points):
        points = {frame: points[frame] for frame in limb.frames.tolist()}
        matching = Volume(volume.origin, volume.weight.shape, volume.voxel_m, volume.truncation_m)
        limb_counts = _fuse_frames(clip, masks, turnaround, matching, points)
        region = limb_region(limb, volume)
        volume.distance[region], volume.weight[region] = matching.distance[region], matching.weight[region]
        off_mask = np.where(region, limb_counts.share_off_mask(), off_mask)
        body = extract(volume, off_mask, below, vertices)
    return body


def _fuse_frames(
    clip: Clip, masks: Masks, turnaround: Turnaround, volume: Volume, frames: Iterable[int]
) -> Silhouettes:
    """Fuse the animal's depth of some frames into a volume and count silhouettes.

    Depth of low confidence counts where its neighbors agree.
    """
    counts = Silhouettes(volume.origin, volume.weight.shape, volume.voxel_m)
    for frame in frames:
        pose, intrinsics = turnaround.world_from_camera[frame], clip.depth_intrinsics[frame]
        labels, depth = depth_labels(masks[frame], clip.depth_size), clip.depth(frame)
        counts.add(labels, depth, intrinsics, pose)
        own = np.where((labels == 255) & supported(depth), depth, 0)
        volume.integrate(own, intrinsics, clip.color(frame), clip.intrinsics[frame], pose)
    return counts


def _on_animal(clip: Clip, masks: Masks, turnaround: Turnaround, frame: int) -> Float[np.ndarray, "point 3"]:
    """Return the points measured on the animal in one frame, in the turnaround's world, meters."""
    depth = clip.depth(frame)
    own = (depth_labels(masks[frame], clip.depth_size) == 255) & supported(depth)
    points_camera = cameras.back_project(depth, clip.depth_intrinsics[frame])[own].astype(float)
    return rigid.apply(turnaround.world_from_camera[frame], points_camera)


def _without_outliers(points_world: Float[np.ndarray, "point 3"]) -> Float[np.ndarray, "point 3"]:
    """Remove points much farther from the middle than nearly all others."""
    distance = np.linalg.norm(points_world - np.median(points_world, axis=0), axis=1)
    return points_world[distance < OUTLIER_FACTOR * np.quantile(distance, OUTLIER_QUANTILE)]


def extract(
    volume: Volume,
    share_off_mask: Float[np.ndarray, "x y z"],
    below_ground: Bool[np.ndarray, "x y z"],
    vertices: int,
) -> ClosedBody:
    """Extract the largest body of the fused volume, smoothed at constant volume and simplified.

    Fused depth counts unless most frames see through a voxel; others are inside if hardly any frame does.
    Raises InputError AGT-001 if hardly any voxel is left.
    """
    fused = volume.weight > 0
    outside = below_ground | (share_off_mask > np.where(fused, MAX_FREE_FUSED, MAX_FREE))
    distance = np.where(outside, 1.0, np.where(fused, volume.distance, -1.0)).astype(np.float32)
    distance = np.pad(distance, 1, constant_values=1.0)
    group, count = cast("tuple[np.ndarray, int]", scipy.ndimage.label(distance < 0))
    own = group == (np.bincount(group.ravel())[1:].argmax() + 1 if count else -1)
    own = np.asarray(scipy.ndimage.binary_fill_holes(own))
    if own.sum() < MIN_CELLS:
        what = f"the turnaround's depth and masks leave {own.sum()} voxels of the animal"
        remedy = "film it again, in better light; see the pictures of its masks"
        raise InputError("AGT-001", what, "turnaround", remedy)
    distance = np.where(own, np.minimum(distance, -MIN_DISTANCE), np.maximum(distance, MIN_DISTANCE))
    distance = scipy.ndimage.gaussian_filter(distance, SMOOTH_VOXELS)
    cells = int((own & scipy.ndimage.binary_dilation(distance < 0)).sum())
    # Smoothing shrinks round shapes: choose the level that keeps the volume.
    volume_level = np.partition(distance, cells, axis=None)[cells]
    points, faces, _, _ = measure.marching_cubes(distance, volume_level)
    origin = volume.origin - volume.voxel_m
    parts = trimesh.Trimesh(points, faces).split(only_watertight=False)
    surface = max(parts, key=lambda part: len(part.faces))
    trimesh.smoothing.filter_taubin(surface, iterations=SMOOTH_ROUNDS)
    points, faces = simplify(surface, vertices)
    mesh = Mesh((points * volume.voxel_m + origin).astype(np.float32), faces.astype(np.int32))
    return ClosedBody(mesh, origin + np.argwhere(own) * volume.voxel_m, volume.voxel_m)


def simplify(
    mesh: trimesh.Trimesh, vertices: int
) -> tuple[Float[np.ndarray, "vertex 3"], Int[np.ndarray, "face 3"]]:
    """Simplify to about ``vertices`` by edge collapse; a closed mesh stays closed and faces outward."""
    share = min(1.0, vertices / len(mesh.vertices))
    points, faces = mesh.vertices, mesh.faces
    if share < 1:
        points = points.astype(np.float32).astype(np.float64)  # as precise as meshes are stored
        points, faces = fast_simplification.simplify(points, faces, 1 - share, agg=AGGRESSIVENESS)[:2]
    result = trimesh.Trimesh(points, faces, process=True)
    if not result.is_watertight:
        trimesh.repair.fill_holes(result)
    trimesh.repair.fix_normals(result)
    return np.asarray(result.vertices), np.asarray(result.faces)


def _below_ground(volume: Volume, turnaround: Turnaround) -> Bool[np.ndarray, "x y z"]:
    """Return which voxels lie below the ground."""
    x, y, z = _axes(volume)
    ground = turnaround.ground
    level = ground.offset_m + x[:, None] * ground.slope[0] + z[None, :] * ground.slope[1]
    return y[None, :, None] < level[:, None, :]


def _axes(volume: Volume) -> list[Float[np.ndarray, "cell"]]:
    """Return the voxel coordinates along each axis, meters."""
    return [volume.origin[axis] + np.arange(volume.weight.shape[axis]) * volume.voxel_m for axis in range(3)]


def find_limb(
    points_world: Mapping[int, Float[np.ndarray, "point 3"]],
    above_ground_m: Mapping[int, Float[np.ndarray, "point"]],
    inside_world: Float[np.ndarray, "cell 3"],
) -> Limb | None:
    """Find the moving limb among the points measured on the animal in each frame; None if all is static."""
    body = KDTree(inside_world)
    off_body = {}
    for frame, points in points_world.items():
        away, _ = body.query(points, distance_upper_bound=MAX_OFF_BODY_M)
        off_body[frame] = (away > OFF_BODY_M) & np.isfinite(away) & (above_ground_m[frame] > MIN_HEIGHT_M)
    points = np.concatenate([points_world[frame][moved] for frame, moved in off_body.items()])
    frame = np.concatenate([np.full(moved.sum(), frame) for frame, moved in off_body.items()])
    if not len(points):
        return None
    place = _densest_place(points, frame, body.query(points)[0])
    seen, count = np.unique(frame[np.linalg.norm(points - place, axis=1) < SAME_PLACE_M], return_counts=True)
    matching = seen[count >= MIN_POINTS]
    return Limb(matching, points) if len(matching) >= MIN_FRAMES else None


def _densest_place(points, frame, away_m) -> Float[np.ndarray, "3"]:
    """Return the place with the largest number of frames times distance from the body."""
    _, cell = np.unique(np.floor(points / SAME_PLACE_M).astype(int), axis=0, return_inverse=True)
    cell = cell.ravel()
    frames = np.bincount(np.unique(np.stack([cell, frame]), axis=1)[0])
    away = np.bincount(cell, away_m) / np.bincount(cell)
    place = points[cell == (frames * away).argmax()].mean(0)
    for _ in range(3):
        place = points[np.linalg.norm(points - place, axis=1) < SAME_PLACE_M].mean(0)
    return place


def limb_region(limb: Limb, volume: Volume) -> Bool[np.ndarray, "x y z"]:
    """Return which voxels of a volume lie near the limb's points."""
    cells = np.stack(np.meshgrid(*_axes(volume), indexing="ij"), axis=-1)
    return np.isfinite(KDTree(limb.points_world).query(cells, distance_upper_bound=LIMB_MARGIN_M)[0])


@njit(cache=True, nogil=True)
def _count(off_mask, within, start, steps, labels, depth, intrinsics):
    height, width = labels.shape
    for i in range(off_mask.shape[0]):
        for j in range(off_mask.shape[1]):
            x0 = start[0] + i * steps[0, 0] + j * steps[1, 0]
            y0 = start[1] + i * steps[0, 1] + j * steps[1, 1]
            z0 = start[2] + i * steps[0, 2] + j * steps[1, 2]
            for k in range(off_mask.shape[2]):
                z = z0 + k * steps[2, 2]
                if z < 0.1:
                    continue
                column = int(np.floor((x0 + k * steps[2, 0]) / z * intrinsics[0, 0] + intrinsics[0, 2]))
                row = int(np.floor((y0 + k * steps[2, 1]) / z * intrinsics[1, 1] + intrinsics[1, 2]))
                if row < 0 or column < 0 or row >= height or column >= width:
                    continue
                if labels[row, column] == 255:
                    within[i, j, k] += 1
                elif labels[row, column] == 0 and depth[row, column] > z:
                    off_mask[i, j, k] += 1
