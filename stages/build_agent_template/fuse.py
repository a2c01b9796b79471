"""Fuse masked depth into one closed surface.

Depth on the animal gives its surface; a pixel off its mask means that the ray is free up to the depth there.
Cells that hardly any frame sees through are inside the body; cells below the ground are outside.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import cast

import fast_simplification
import numpy as np
import scipy.ndimage
import trimesh
from jaxtyping import Bool, Float, Int
from skimage import measure

from pipeline.data.clips import Clip, Masks
from pipeline.geometry import cameras, rigid
from pipeline.geometry.flying_pixels import supported
from pipeline.geometry.meshes import Mesh
from pipeline.geometry.tsdf import Volume, enclose
from stages.build_agent_template.carve import Silhouettes
from stages.build_agent_template.limbs import find_limb, space_of
from stages.build_agent_template.poses import Circle, depth_labels

TRUNCATION_M = 0.03
"""depth error that averages out"""
SEE_THROUGH, SEE_THROUGH_FUSED = 0.08, 0.4
"""share of the frames that must see through a cell to carve it, without and with fused depth"""
SMOOTH_VOXELS, SMOOTH_ROUNDS = 0.8, 6
"""standard deviation of the smoothing of the signed distance, and rounds of Taubin smoothing of the
surface"""
STRAY, STRAY_QUANTILE = 1.6, 0.98
"""points farther from the middle than so many times this quantile are strays"""
LEAST_DISTANCE = 0.05
"""cells inside and outside keep at least this signed distance, in units of the truncation"""
AGGRESSIVENESS = 4
"""of edge collapse: lower keeps shape better"""


@dataclass(frozen=True)
class ClosedBody:
    """The animal's closed surface in the turnaround's world, and the cells inside it."""

    mesh: Mesh
    inside_world: Float[np.ndarray, "cell 3"]
    voxel_m: float


def fuse(clip: Clip, masks: Masks, circle: Circle, voxel_m: float, vertices: int) -> ClosedBody:
    """Fuse and carve all frames that show the animal, then extract the largest closed surface.

    Where a limb moved, only the frames in which it stood alike count; parts farther out, as a tail's tip,
    move more, and of these frames again only those count in which they stood alike.
    """
    points = {
        int(frame): _on_animal(clip, masks, circle, int(frame)) for frame in np.flatnonzero(masks.visible)
    }
    volume = enclose(
        _without_strays(np.concatenate(list(points.values()))), voxel_m=voxel_m, truncation_m=TRUNCATION_M
    )
    silhouettes = _gather(clip, masks, circle, volume, points)
    off_mask, below = silhouettes.share_off_mask(), _below(volume, circle)
    body = extract(volume, off_mask, below, vertices)
    above = {frame: circle.ground.above(each) for frame, each in points.items()}
    while (limb := find_limb(points, above, body.inside_world)) is not None and len(limb.frames) < len(
        points
    ):
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
    return rigid.apply(
        circle.world_from_camera[frame],
        cameras.back_project(depth, clip.depth_intrinsics[frame])[own].astype(float),
    )


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
    """Close the fused volume and return its largest body, smoothed and with fewer vertices, but as large as
    it was.

    Fused depth counts unless most frames see through a cell; elsewhere a cell is inside if hardly any frame
    does.
    """
    fused = volume.weight > 0
    outside = below_ground | (share_off_mask > np.where(fused, SEE_THROUGH_FUSED, SEE_THROUGH))
    distance = np.where(outside, 1.0, np.where(fused, volume.distance, -1.0)).astype(np.float32)
    distance = np.pad(distance, 1, constant_values=1.0)
    group, count = cast("tuple[np.ndarray, int]", scipy.ndimage.label(distance < 0))
    own = group == (np.bincount(group.ravel())[1:].argmax() + 1 if count else -1)
    own = np.asarray(scipy.ndimage.binary_fill_holes(own))
    distance = np.where(own, np.minimum(distance, -LEAST_DISTANCE), np.maximum(distance, LEAST_DISTANCE))
    distance = scipy.ndimage.gaussian_filter(distance, SMOOTH_VOXELS)
    cells = int((own & scipy.ndimage.binary_dilation(distance < 0)).sum())
    as_large = np.partition(distance, cells, axis=None)[
        cells
    ]  # smoothing eats what is round, and should eat scraps alone
    points, faces, _, _ = measure.marching_cubes(distance, as_large)
    origin = volume.origin - volume.voxel_m
    surface = max(
        trimesh.Trimesh(points, faces).split(only_watertight=False), key=lambda part: len(part.faces)
    )
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
    axes = [volume.origin[axis] + np.arange(volume.weight.shape[axis]) * volume.voxel_m for axis in range(3)]
    level = (
        circle.ground.offset_m
        + axes[0][:, None] * circle.ground.slope[0]
        + axes[2][None, :] * circle.ground.slope[1]
    )
    return axes[1][None, :, None] < level[:, None, :]
