"""Fuse masked depth into one closed surface.

A pixel on the animal says where its surface is; a pixel beside it says that its ray is free up to the depth there.
What hardly any frame sees through is inside the body; below the ground is outside.
"""

from collections.abc import Iterable
from dataclasses import dataclass, field

import cv2
import fast_simplification
import numpy as np
import scipy.ndimage
import trimesh
from jaxtyping import Bool, Float, UInt8
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

    Where a limb moved, the frames in which it stood alike decide.
    """
    seen = np.flatnonzero(masks.visible).tolist()
    volume, silhouettes = _gathered(clip, masks, circle, options, seen)
    beside, below = silhouettes.share_beside(), _below(volume, circle)
    body = extract(volume, beside, below, options)
    points = {frame: _on_animal(clip, masks, circle, frame) for frame in seen}
    above = {frame: circle.ground.above(each) for frame, each in points.items()}
    limb = find_limb(points, above, body.inside_world, options.moving)
    if limb is None:
        return body
    alike, outlines = _gathered(clip, masks, circle, options, limb.frames.tolist(), thin=True)
    there = space_of(limb, volume, options.moving)
    volume.distance[there], volume.weight[there] = alike.distance[there], alike.weight[there]
    return extract(volume, np.where(there, outlines.share_beside(), beside), below, options)


def _gathered(
    clip: Clip, masks: Masks, circle: Circle, options: Fusion, frames: Iterable[int], thin: bool = False
) -> tuple[Volume, Silhouettes]:
    """Fuse the animal's depth and its outlines in some frames; ``thin`` keeps depth that the sensor doubts where neighbours agree."""
    volume = enclose(circle.points_world, voxel_m=options.voxel_m, truncation_m=options.truncation_m)
    silhouettes = Silhouettes(volume.origin, volume.weight.shape, volume.voxel_m)
    for frame in frames:
        pose, intrinsics = circle.world_from_camera[frame], clip.depth_intrinsics[frame]
        labels, depth = depth_labels(masks[frame], clip.depth_size), clip.depth(frame)
        silhouettes.add(labels, depth, intrinsics, pose)
        trusted = np.where(supported(depth), depth, 0) if thin else _trusted(depth, clip.confidence(frame))
        volume.integrate(np.where(labels == 255, trusted, 0), intrinsics, clip.color(frame), clip.intrinsics[frame], pose)
    return volume, silhouettes


def _on_animal(clip: Clip, masks: Masks, circle: Circle, frame: int) -> Float[np.ndarray, "point 3"]:
    """Return the points measured on the animal in one frame, thin limbs included, in the turnaround's world."""
    depth = clip.depth(frame)
    own = (depth_labels(masks[frame], clip.depth_size) == 255) & supported(depth)
    return rigid.apply(circle.world_from_camera[frame], cameras.back_project(depth, clip.depth_intrinsics[frame])[own].astype(float))


def extract(volume: Volume, share_beside: Float[np.ndarray, "x y z"], below_ground: Bool[np.ndarray, "x y z"], options: Fusion) -> Body:
    """Close the fused volume and return its largest body, smoothed and thinned.

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
    vertices, faces, _, _ = measure.marching_cubes(distance, 0.0)
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


def _trusted(depth: Float[np.ndarray, "height width"], confidence: UInt8[np.ndarray, "height width"]) -> Float[np.ndarray, "height width"]:
    """Drop depth (0 = unknown) of low confidence and flying pixels at steps."""
    around = np.ones((3, 3), np.uint8)
    step = cv2.dilate(depth, around) - cv2.erode(depth, around)
    return np.where((confidence > 0) & (step < 0.06 + 0.02 * depth), depth, 0)


def _below(volume: Volume, circle: Circle) -> Bool[np.ndarray, "x y z"]:
    """Tell which cells lie under the ground."""
    axes = [volume.origin[axis] + np.arange(volume.weight.shape[axis]) * volume.voxel_m for axis in range(3)]
    level = circle.ground.offset_m + axes[0][:, None] * circle.ground.slope[0] + axes[2][None, :] * circle.ground.slope[1]
    return axes[1][None, :, None] < level[:, None, :]
