"""Fuse masked depth into one closed surface.

Depth on the animal gives its surface; a pixel off its mask means that the ray is free up to the depth there
(`Silhouettes`). Cells that hardly any frame sees through are inside the body; cells below the ground are
outside. A tail that swings meanwhile would be carved away: points measured off the still body show where such
a limb has been (`find_limb`), and there only the frames in which it stood alike are fused.
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

from pipeline.data.clips import Clip, Masks
from pipeline.geometry import cameras, rigid
from pipeline.geometry.flying_pixels import supported
from pipeline.geometry.meshes import Mesh
from pipeline.geometry.tsdf import Volume, enclose
from stages.build_agent_template.poses import Circle, depth_labels

TRUNCATION_M = 0.03
"""depth error that averages out"""
SEE_THROUGH, SEE_THROUGH_FUSED = 0.08, 0.4
"""share of the frames that must see through a cell to carve it, without and with fused depth"""
SMOOTH_VOXELS, SMOOTH_ROUNDS = 0.8, 6
"""standard deviation of the smoothing of the signed distance; rounds of Taubin smoothing of the surface"""
STRAY, STRAY_QUANTILE = 1.6, 0.98
"""points farther from the middle than so many times this quantile are strays"""
MIN_DISTANCE = 0.05
"""cells inside and outside keep at least this signed distance, in units of the truncation"""
AGGRESSIVENESS = 4
"""of edge collapse: lower keeps shape better"""
BESIDE_M = 0.025
"""measured points this far from the still body belong to what moved"""
FARTHEST_M = 0.35
"""unless they lie farther away than this"""
LOWEST_M = 0.02
"""or nearer to the ground than this"""
ALIKE_M = 0.03
"""frames are alike that saw the limb within this of one place"""
MIN_POINTS, MIN_FRAMES = 3, 12
"""with at least so many points; fewer alike frames do not determine its shape"""
AROUND_M = 0.03
"""the limb's space reaches this far around all that was measured of it"""


@dataclass(frozen=True)
class ClosedBody:
    """The animal's closed surface in the turnaround's world, and the cells inside it."""

    mesh: Mesh
    inside_world: Float[np.ndarray, "cell 3"]
    voxel_m: float


@dataclass(frozen=True)
class Limb:
    """Where a limb has been, and when it stood alike."""

    frames: Int[np.ndarray, "alike"]
    points_world: Float[np.ndarray, "point 3"]
    """measured on it in all frames"""


class Silhouettes:
    """Per cell of a grid: in how many frames its ray passes beside the animal, and meets its picture."""

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
        """Count one frame, labels 255 animal, 0 not, 128 unknown: off the mask for cells before the depth."""
        camera_from_world = rigid.inverse(world_from_camera)
        start = camera_from_world[:3, :3] @ self.origin + camera_from_world[:3, 3]
        steps = np.ascontiguousarray(camera_from_world[:3, :3].T * self.voxel_m)
        depth = np.ascontiguousarray(depth, np.float32)
        _count(self.off_mask, self.within, start, steps, labels, depth, intrinsics)

    def share_off_mask(self) -> Float[np.ndarray, "x y z"]:
        """Return the share of the frames that see a cell beside the animal; 0 where none sees it at all."""
        return self.off_mask / np.maximum(self.off_mask + self.within, 1)


def fuse(clip: Clip, masks: Masks, circle: Circle, voxel_m: float, vertices: int) -> ClosedBody:
    """Fuse and carve all frames that show the animal, then extract the largest closed surface.

    Where a limb moved, only the frames in which it stood alike count; parts farther out, as a tail's tip,
    move more, and of these frames again only those count in which they stood alike.
    """
    frames = np.flatnonzero(masks.visible).tolist()
    points = {frame: _on_animal(clip, masks, circle, frame) for frame in frames}
    together = _without_strays(np.concatenate(list(points.values())))
    volume = enclose(together, voxel_m=voxel_m, truncation_m=TRUNCATION_M)
    silhouettes = _gather(clip, masks, circle, volume, points)
    off_mask, below = silhouettes.share_off_mask(), _below(volume, circle)
    body = extract(volume, off_mask, below, vertices)
    above = {frame: circle.ground.above(each) for frame, each in points.items()}
    while (limb := find_limb(points, above, body.inside_world)) and len(limb.frames) < len(points):
        points = {frame: points[frame] for frame in limb.frames.tolist()}
        matching = Volume(volume.origin, volume.weight.shape, volume.voxel_m, volume.truncation_m)
        silhouettes_there = _gather(clip, masks, circle, matching, points)
        there = space_of(limb, volume)
        volume.distance[there], volume.weight[there] = matching.distance[there], matching.weight[there]
        off_mask = np.where(there, silhouettes_there.share_off_mask(), off_mask)
        body = extract(volume, off_mask, below, vertices)
    return body


def _gather(clip: Clip, masks: Masks, circle: Circle, volume: Volume, frames: Iterable[int]) -> Silhouettes:
    """Fuse the animal's depth in some frames into a volume and count its silhouettes.

    Depth of low confidence counts where its neighbours agree.
    """
    silhouettes = Silhouettes(volume.origin, volume.weight.shape, volume.voxel_m)
    for frame in frames:
        pose, intrinsics = circle.world_from_camera[frame], clip.depth_intrinsics[frame]
        labels, depth = depth_labels(masks[frame], clip.depth_size), clip.depth(frame)
        silhouettes.add(labels, depth, intrinsics, pose)
        own = np.where((labels == 255) & supported(depth), depth, 0)
        volume.integrate(own, intrinsics, clip.color(frame), clip.intrinsics[frame], pose)
    return silhouettes


def _on_animal(clip: Clip, masks: Masks, circle: Circle, frame: int) -> Float[np.ndarray, "point 3"]:
    """Return the points measured on the animal in one frame, in the turnaround's world, metres."""
    depth = clip.depth(frame)
    own = (depth_labels(masks[frame], clip.depth_size) == 255) & supported(depth)
    points_camera = cameras.back_project(depth, clip.depth_intrinsics[frame])[own].astype(float)
    return rigid.apply(circle.world_from_camera[frame], points_camera)


def _without_strays(points_world: Float[np.ndarray, "point 3"]) -> Float[np.ndarray, "point 3"]:
    """Leave out points much farther from the middle than nearly all others."""
    distance = np.linalg.norm(points_world - np.median(points_world, axis=0), axis=1)
    return points_world[distance < STRAY * np.quantile(distance, STRAY_QUANTILE)]


def extract(
    volume: Volume,
    share_off_mask: Float[np.ndarray, "x y z"],
    below_ground: Bool[np.ndarray, "x y z"],
    vertices: int,
) -> ClosedBody:
    """Close the fused volume and return its largest body, smoothed, with fewer vertices, but as large.

    Fused depth counts unless most frames see through a cell; elsewhere it is inside if hardly any frame does.
    """
    fused = volume.weight > 0
    outside = below_ground | (share_off_mask > np.where(fused, SEE_THROUGH_FUSED, SEE_THROUGH))
    distance = np.where(outside, 1.0, np.where(fused, volume.distance, -1.0)).astype(np.float32)
    distance = np.pad(distance, 1, constant_values=1.0)
    group, count = cast("tuple[np.ndarray, int]", scipy.ndimage.label(distance < 0))
    own = group == (np.bincount(group.ravel())[1:].argmax() + 1 if count else -1)
    own = np.asarray(scipy.ndimage.binary_fill_holes(own))
    distance = np.where(own, np.minimum(distance, -MIN_DISTANCE), np.maximum(distance, MIN_DISTANCE))
    distance = scipy.ndimage.gaussian_filter(distance, SMOOTH_VOXELS)
    cells = int((own & scipy.ndimage.binary_dilation(distance < 0)).sum())
    # Smoothing eats what is round, and should eat scraps alone.
    as_large = np.partition(distance, cells, axis=None)[cells]
    points, faces, _, _ = measure.marching_cubes(distance, as_large)
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
    """Collapse edges until about so many vertices are left; a closed mesh stays closed and faces outward."""
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


def _below(volume: Volume, circle: Circle) -> Bool[np.ndarray, "x y z"]:
    """Return which cells lie below the ground."""
    x, y, z = _axes(volume)
    ground = circle.ground
    level = ground.offset_m + x[:, None] * ground.slope[0] + z[None, :] * ground.slope[1]
    return y[None, :, None] < level[:, None, :]


def _axes(volume: Volume) -> list[Float[np.ndarray, "cell"]]:
    """Return where a volume's cells lie along each axis, metres."""
    return [volume.origin[axis] + np.arange(volume.weight.shape[axis]) * volume.voxel_m for axis in range(3)]


def find_limb(
    points_world: Mapping[int, Float[np.ndarray, "point 3"]],
    above_ground_m: Mapping[int, Float[np.ndarray, "point"]],
    inside_world: Float[np.ndarray, "cell 3"],
) -> Limb | None:
    """Find what moved among the points measured on the animal in each frame; None when all stood still."""
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
    matching = seen[count >= MIN_POINTS]
    return Limb(matching, points) if len(matching) >= MIN_FRAMES else None


def _common_place(points, frame, away_m) -> Float[np.ndarray, "3"]:
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
    cells = np.stack(np.meshgrid(*_axes(volume), indexing="ij"), axis=-1)
    return np.isfinite(KDTree(limb.points_world).query(cells, distance_upper_bound=AROUND_M)[0])


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
