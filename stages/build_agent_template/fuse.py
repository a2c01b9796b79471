"""Fuse masked depth into one closed surface.

A pixel on the animal says where its surface is; a pixel beside it says that its ray is free up to the depth there.
What hardly any frame sees through is inside the body; below the ground is outside.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field

import fast_simplification
import numpy as np
import scipy.ndimage
import trimesh
from jaxtyping import Bool, Float
from skimage import measure

from pipeline.files.clips import Clip, Masks
from pipeline.space import cameras, rigid
from pipeline.space.meshes import Mesh
from pipeline.space.thin_depth import supported
from pipeline.space.tsdf import Volume, enclose
from stages.build_agent_template.carve import Silhouettes
from stages.build_agent_template.limbs import Moving, find_limb, space_of
from stages.build_agent_template.poses import Circle, depth_labels


@dataclass(frozen=True)
class Fusion:
    """How the surface is made."""

    voxel_m: float = 0.008
    """size of the volume's cells"""
    truncation_m: float = 0.03
    """depth error that averages out"""
    see_through: float = 0.08
    """share of the frames that must see through a cell without depth to carve it"""
    see_through_fused: float = 0.4
    """the same for a cell whose distance was fused"""
    smooth_voxels: float = 0.8
    """standard deviation of the smoothing of the signed distance"""
    vertices: int = 3000
    """about how many vertices the surface keeps"""
    moving: Moving = field(default_factory=Moving)
    """how limbs that moved are found"""


@dataclass(frozen=True)
class Body:
    """The animal's closed surface in the turnaround's world, and the cells inside it."""

    mesh: Mesh
    inside_world: Float[np.ndarray, "cell 3"]
    voxel_m: float


def fuse(clip: Clip, masks: Masks, circle: Circle, options: Fusion) -> Body:
    """Fuse and carve all frames that show the animal, then extract the largest closed surface.

    Where a limb moved, the frames in which it stood alike decide; what lies farther out on it, as a tail's tip, moves more,
    and of these frames again those decide in which that stood alike.
    """
    points = {int(frame): _on_animal(clip, masks, circle, int(frame)) for frame in np.flatnonzero(masks.visible)}
    volume = enclose(_without_strays(np.concatenate(list(points.values()))), voxel_m=options.voxel_m, truncation_m=options.truncation_m)
    silhouettes = _gather(clip, masks, circle, volume, points)
    beside, below = silhouettes.share_beside(), _below(volume, circle)
    body = extract(volume, beside, below, options)
    above = {frame: circle.ground.above(each) for frame, each in points.items()}
    while (limb := find_limb(points, above, body.inside_world, options.moving)) is not None and len(limb.frames) < len(points):
        points = {frame: points[frame] for frame in limb.frames.tolist()}
        alike = Volume(volume.origin, volume.weight.shape, volume.voxel_m, volume.truncation_m)
        outlines = _gather(clip, masks, circle, alike, points)
        there = space_of(limb, volume, options.moving)
        volume.distance[there], volume.weight[there] = alike.distance[there], alike.weight[there]
        beside = np.where(there, outlines.share_beside(), beside)
        body = extract(volume, beside, below, options)
    return body


def _gather(clip: Clip, masks: Masks, circle: Circle, volume: Volume, frames: Iterable[int]) -> Silhouettes:
    """Fuse the animal's depth in some frames into a volume and count its outlines; depth that the sensor doubts stays where neighbours agree."""
    silhouettes = Silhouettes(volume.origin, volume.weight.shape, volume.voxel_m)
    for frame in frames:
        pose, intrinsics = circle.world_from_camera[frame], clip.depth_intrinsics[frame]
        labels, depth = depth_labels(masks[frame], clip.depth_size), clip.depth(frame)
        silhouettes.add(labels, depth, intrinsics, pose)
        own = np.where((labels == 255) & supported(depth), depth, 0)
        volume.integrate(own, intrinsics, clip.color(frame), clip.intrinsics[frame], pose)
    return silhouettes


def _on_animal(clip: Clip, masks: Masks, circle: Circle, frame: int) -> Float[np.ndarray, "point 3"]:
    """Return the points measured on the animal in one frame, thin limbs included, in the turnaround's world."""
    depth = clip.depth(frame)
    own = (depth_labels(masks[frame], clip.depth_size) == 255) & supported(depth)
    return rigid.apply(circle.world_from_camera[frame], cameras.back_project(depth, clip.depth_intrinsics[frame])[own].astype(float))


def _without_strays(points_world: Float[np.ndarray, "point 3"]) -> Float[np.ndarray, "point 3"]:
    """Leave out points much farther from the middle than nearly all others."""
    distance = np.linalg.norm(points_world - np.median(points_world, axis=0), axis=1)
    return points_world[distance < 1.6 * np.quantile(distance, 0.98)]


def extract(volume: Volume, share_beside: Float[np.ndarray, "x y z"], below_ground: Bool[np.ndarray, "x y z"], options: Fusion) -> Body:
    """Close the fused volume and return its largest body, smoothed and with fewer vertices, but as large as it was.

    Where depth was fused it decides unless most frames see through; elsewhere a cell is inside that hardly any frame
    sees through.
    """
    fused = volume.weight > 0
    outside = below_ground | (share_beside > np.where(fused, options.see_through_fused, options.see_through))
    distance = np.where(outside, 1.0, np.where(fused, volume.distance, -1.0)).astype(np.float32)
    distance = np.pad(distance, 1, constant_values=1.0)
    group, count = scipy.ndimage.label(distance < 0)
    own = group == (np.bincount(group.ravel())[1:].argmax() + 1 if count else -1)
    own = scipy.ndimage.binary_fill_holes(own)
    distance = np.where(own, np.minimum(distance, -0.05), np.maximum(distance, 0.05))
    distance = scipy.ndimage.gaussian_filter(distance, options.smooth_voxels)
    cells = int((own & scipy.ndimage.binary_dilation(distance < 0)).sum())
    as_large = np.partition(distance, cells, axis=None)[cells]  # smoothing eats what is round, and should eat scraps alone
    vertices, faces, _, _ = measure.marching_cubes(distance, as_large)
    origin = volume.origin - options.voxel_m
    surface = max(trimesh.Trimesh(vertices, faces).split(only_watertight=False), key=lambda part: len(part.faces))
    trimesh.smoothing.filter_taubin(surface, iterations=6)
    vertices, faces = thin(surface, options.vertices)
    mesh = Mesh((vertices * options.voxel_m + origin).astype(np.float32), faces.astype(np.int32))
    return Body(mesh, origin + np.argwhere(own) * options.voxel_m, options.voxel_m)


def thin(mesh: trimesh.Trimesh, vertices: int) -> tuple[Float[np.ndarray, "vertex 3"], np.ndarray]:
    """Remove edges until about so many vertices are left; a closed mesh stays closed and faces outward."""
    share = min(1.0, vertices / len(mesh.vertices))
    points, faces = mesh.vertices, mesh.faces
    if share < 1:
        points, faces = fast_simplification.simplify(points.astype(np.float32), faces, 1 - share, agg=4)
    result = trimesh.Trimesh(points, faces, process=True)
    if not result.is_watertight:
        trimesh.repair.fill_holes(result)
    trimesh.repair.fix_normals(result)
    return np.asarray(result.vertices), np.asarray(result.faces)


def _below(volume: Volume, circle: Circle) -> Bool[np.ndarray, "x y z"]:
    """Tell which cells lie under the ground."""
    axes = [volume.origin[axis] + np.arange(volume.weight.shape[axis]) * volume.voxel_m for axis in range(3)]
    level = circle.ground.offset_m + axes[0][:, None] * circle.ground.slope[0] + axes[2][None, :] * circle.ground.slope[1]
    return axes[1][None, :, None] < level[:, None, :]
