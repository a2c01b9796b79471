"""Fuse masked depth into one closed surface.

A pixel on the animal says where its surface is; a pixel beside it says that its whole ray is free, which carves the
floor away. What no ray ever reached is inside the body; below the ground is outside.
"""

from dataclasses import dataclass

import cv2
import fast_simplification
import numpy as np
import scipy.ndimage
import trimesh
from jaxtyping import Bool, Float
from skimage import measure

from pipeline.files.clips import Clip, Masks
from pipeline.space import rigid
from pipeline.space.meshes import Mesh
from pipeline.space.tsdf import Volume, enclose
from stages.build_agent_template.poses import Circle, depth_labels


@dataclass(frozen=True)
class Fusion:
    """How the surface is made."""

    voxel_m: float = 0.008
    """size of the volume's cells"""
    truncation_m: float = 0.03
    """depth error that averages out"""
    smooth_voxels: float = 0.8
    """standard deviation of the smoothing of the signed distance"""
    vertices: int = 3000
    """about how many vertices the surface keeps"""


@dataclass(frozen=True)
class Body:
    """The animal's closed surface in the turnaround's world, and the cells inside it."""

    mesh: Mesh
    inside_world: Float[np.ndarray, "cell 3"]
    voxel_m: float


def fuse(clip: Clip, masks: Masks, circle: Circle, options: Fusion) -> Body:
    """Carve and fuse all frames that show the animal, then extract the largest closed surface."""
    volume = enclose(circle.points_world, voxel_m=options.voxel_m, truncation_m=options.truncation_m)
    middle = circle.points_world.mean(0)
    for frame in np.flatnonzero(masks.visible):
        pose = circle.world_from_camera[frame]
        beyond = float(rigid.apply(rigid.inverse(pose), middle[None])[0, 2]) + 1.0
        label = depth_labels(masks[frame], clip.depth_size)
        depth = np.where(label == 255, _trusted(clip, frame), np.where(label == 0, beyond, 0))
        volume.integrate(depth, clip.depth_intrinsics[frame], clip.color(frame), clip.intrinsics[frame], pose)
    return extract(volume, _below(volume, circle), options)


def extract(volume: Volume, below_ground: Bool[np.ndarray, "x y z"], options: Fusion) -> Body:
    """Close the fused volume and return its largest body, smoothed and thinned."""
    distance = np.where(volume.weight > 0, volume.distance, -1.0).astype(np.float32)
    distance[below_ground] = 1.0
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


def _trusted(clip: Clip, frame: int) -> Float[np.ndarray, "height width"]:
    """Depth without low confidence and without flying pixels at steps."""
    depth = clip.depth(frame)
    around = np.ones((3, 3), np.uint8)
    step = cv2.dilate(depth, around) - cv2.erode(depth, around)
    return np.where((clip.confidence(frame) > 0) & (step < 0.06 + 0.02 * depth), depth, 0)


def _below(volume: Volume, circle: Circle) -> Bool[np.ndarray, "x y z"]:
    """Tell which cells lie under the ground."""
    axes = [volume.origin[axis] + np.arange(volume.weight.shape[axis]) * volume.voxel_m for axis in range(3)]
    level = circle.ground.offset_m + axes[0][:, None] * circle.ground.slope[0] + axes[2][None, :] * circle.ground.slope[1]
    return axes[1][None, :, None] < level[:, None, :]
