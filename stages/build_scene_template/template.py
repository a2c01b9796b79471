"""Build a template from a walk-through: structure from motion, refinement, fusion, alignment."""

from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import pycolmap
from jaxtyping import Bool, Float

from pipeline.core.errors import InputError
from pipeline.core.progress import log
from pipeline.data.clips import Clip, usable_depth
from pipeline.geometry import rigid, subsampling
from pipeline.geometry.meshes import Mesh
from pipeline.mapping.colmap import SparseModel
from pipeline.mapping.icp import depth_views
from pipeline.mapping.odometry import JUMP_STRIDE_PX, find_jumps, repair
from stages.build_scene_template import anchor, fuse, refine, sfm
from stages.build_scene_template.config import Config

MIN_POINTS = 100
"""Least number of depth points with a normal, and of faces of the fused mesh."""
UP_COSINE, FLOOR_SHARE, FLOOR_BAND_M = 0.9, 0.05, 0.1
"""Least upward normal component of level surface, quantile of its heights at which the floor begins, and how
far up from there it reaches, meters: with a noisy sensor, the lowest surface lies below the floor."""


@dataclass(frozen=True)
class SceneTemplate:
    """The scene's surface in the world, the walk-through's cameras, and the source of both."""

    mesh: Mesh
    features: Float[np.ndarray, "vertex channel"]
    world_from_camera: Float[np.ndarray, "frame 4 4"]
    registered: Bool[np.ndarray, "frame"]
    gap_m: Float[np.ndarray, "frame"]
    """Median distance of each frame's depth from the surface, meters."""
    start: anchor.InitialTrajectory
    keyframe: Bool[np.ndarray, "frame"]
    """Frames whose cameras were jointly optimized."""
    reprojection_px: float | None
    gravity: str
    floor_m: float
    """Height of the floor, world y."""
    scale: str
    """Source of metric scale (`Clip.scale`)."""
    odometry_scale: float | None = None
    """`anchor.odometry_scale` of the registered frames; None if it was not measured."""
    own_mesh: bool = False
    """Whether the mesh came with the recording."""


def build(
    clip: Clip, features: Float[np.ndarray, "frame height width channel"], config: Config, workspace: Path
) -> tuple[SceneTemplate, SparseModel | None]:
    """Build the template; also return the SfM model. Raises InputError MAP-001, MAP-002, MAP-003, MAP-005."""
    clip = without_jumps(clip)
    sparse = sfm.reconstruct(clip, config.sfm, workspace, config.seed)
    frames = sfm.choose_keyframes(clip, config.sfm)
    keyframes = [refine.load_keyframe(clip, int(frame)) for frame in frames]
    start = anchor.choose_trajectory(clip, frames, keyframes, sparse)
    if start is None:
        what = "the walk-through has no odometry, and COLMAP found no metric model in it"
        raise InputError("MAP-001", what, str(clip.folder), "record a slower walk-through in better light")
    why = f": {start.reason}" if start.reason else ""
    log(f"start from {start.source}{why}; {len(start.registered)} of {len(frames)} keyframes in the model")
    tracked = sfm.tracked_points(clip, workspace / sfm.DATABASE, frames)
    key_poses = start.world_from_camera[frames]
    key_poses = refine.refine_keyframes(clip, frames, keyframes, key_poses, tracked, config.refinement)
    poses = anchor.propagate(clip, frames, key_poses)
    points, normals = _oriented_points(keyframes, key_poses)
    if len(points) < MIN_POINTS:
        raise _no_surface_error(clip)
    upright_from_world, gravity = anchor.upright(clip, poses, points, normals)
    mesh = fuse.fuse(clip, frames, upright_from_world @ poses, config.fusion)
    if len(mesh.faces) < MIN_POINTS:
        raise _no_surface_error(clip)
    poses, gap, fit = fuse.align_frames(clip, mesh, upright_from_world @ poses, config.fusion, frames)
    registered = fuse.registered(fit)
    known = np.flatnonzero(registered)
    if not len(known):
        raise _no_surface_error(clip)
    mesh = fuse.fuse(clip, known, poses, config.fusion)
    mesh = fuse.clean(mesh, workspace, config.fusion.island_faces)
    if mesh is None:
        raise _no_surface_error(clip)
    log(f"{len(mesh.faces)} faces; median gap of depth from the surface {np.nanmedian(gap) * 100:.1f} cm")
    shown = subsampling.some(known, config.fusion.feature_frames)
    built = SceneTemplate(
        mesh=mesh,
        features=fuse.vertex_features(clip, features, mesh, poses, shown),
        world_from_camera=poses,
        registered=registered,
        gap_m=gap,
        start=start,
        keyframe=np.isin(np.arange(len(clip)), frames),
        reprojection_px=None if sparse is None else sparse.reprojection_px,
        gravity=gravity,
        floor_m=floor_height(mesh),
        scale=clip.scale,
        odometry_scale=anchor.odometry_scale(clip, np.where(registered[:, None, None], poses, np.nan)),
    )
    return built, sparse


def without_jumps(clip: Clip) -> Clip:
    """Return the walk-through with its odometry repaired at tracking jumps."""
    if clip.odometry_from_camera is None:
        return clip
    view = depth_views(partial(usable_depth, clip), clip.depth_intrinsics, JUMP_STRIDE_PX)
    jumps = find_jumps(clip.timestamp_s, clip.odometry_from_camera, view)
    if not jumps.any():
        return clip
    log(f"tracking jumps before {int(jumps.sum())} of {len(clip)} frames: odometry is repaired there")
    return replace(clip, odometry_from_camera=repair(clip.timestamp_s, clip.odometry_from_camera, jumps))


def _oriented_points(keyframes, world_from_camera):
    """Return the keyframes' depth points with normals, world frame."""
    pairs = list(zip(keyframes, world_from_camera, strict=True))
    normals = np.concatenate([k.normals.reshape(-1, 3)[k.scan.pixel_index] @ p[:3, :3].T for k, p in pairs])
    points = np.concatenate([rigid.apply(p, k.scan.points_camera) for k, p in pairs])
    known = np.abs(normals).sum(1) > 0
    return points[known], normals[known]


def _no_surface_error(clip: Clip) -> InputError:
    remedy = "check that the recording has LiDAR depth within 4 m"
    return InputError("MAP-002", "depth fused to no surface", str(clip.folder), remedy)


def floor_height(mesh: Mesh) -> float:
    """Return the median height of the lowest upward-facing surface, world y."""
    height = mesh.vertices[mesh.vertex_normals()[:, 1] > UP_COSINE, 1]
    if not len(height):
        return float(mesh.vertices[:, 1].min())
    above = height - np.quantile(height, FLOOR_SHARE)
    return float(np.median(height[(above >= 0) & (above < FLOOR_BAND_M)]))


def write_model(
    sparse: SparseModel | None, world_from_camera: Float[np.ndarray, "frame 4 4"], folder: Path
) -> None:
    """Write COLMAP's model as text, aligned to the world by a similarity of camera centers."""
    folder.mkdir()
    if sparse is None:
        (folder / "README.txt").write_text("COLMAP found no model in this walk-through.\n")
        return
    centers = sparse.model_from_camera[:, :3, 3], world_from_camera[sparse.frame][:, :3, 3]
    world_from_model = pycolmap.estimate_sim3d(*centers)
    if world_from_model is not None:
        sparse.reconstruction.transform(world_from_model)
    sparse.reconstruction.write_text(folder)
