"""The whole way from a walk-through to its template: what the front calls, and what it gets back."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from jaxtyping import Bool, Float

from pipeline.errors import InputError
from pipeline.files.clips import Clip
from pipeline.progress import log
from pipeline.space import rigid
from pipeline.space.meshes import Mesh
from pipeline.space.sparse import Sparse
from stages.build_scene_template import anchor, fuse, refine, sfm

LEAST_POINTS = 100
"""measured points with a surface direction below which there is nothing to fuse"""


@dataclass(frozen=True)
class Template:
    """The scene's surface in the world, the walk-through's cameras, and how they were found."""

    mesh: Mesh
    features: Float[np.ndarray, "vertex channel"]
    world_from_camera: Float[np.ndarray, "frame 4 4"]
    registered: Bool[np.ndarray, "frame"]
    gap_m: Float[np.ndarray, "frame"]
    """Median distance of each frame's depth from the surface."""
    start: anchor.Trajectory
    keyframes: int
    reprojection_px: float | None
    gravity: str
    floor_m: float
    """Height of the floor, world y."""
    scale: str
    """What makes lengths metres (`Clip.scale`)."""
    own_mesh: bool = False
    """Whether the recording brought its surface along."""


def build(
    clip: Clip,
    features: Float[np.ndarray, "frame height width channel"],
    *,
    structure: sfm.SfmOptions,
    believe: anchor.AnchorOptions,
    weights: refine.RefineOptions,
    fusion: fuse.FuseOptions,
    workspace: Path,
    seed: int,
) -> tuple[Template, Sparse | None]:
    """Build the template; the sparse model comes back in the world, ready to be written. Raises InputError MAP-001
    and MAP-002.
    """
    sparse = sfm.reconstruct(clip, structure, workspace, seed)
    frames = sfm.choose_keyframes(clip, structure)
    keyframes = [refine.load_keyframe(clip, int(frame), weights.stride_px) for frame in frames]
    start = anchor.choose_start(clip, frames, keyframes, sparse, believe)
    if start is None:
        raise InputError(
            "MAP-001",
            "the walk-through has no odometry, and COLMAP found no metric model in it",
            str(clip.folder),
            "record a slower walk-through in better light",
        )
    log(
        f"start from {start.source}{': ' + start.reason if start.reason else ''}; "
        f"{len(start.registered)} of {len(frames)} keyframes in the model"
    )
    trusted = sparse if start.source == "colmap" else None
    keys = refine.refine_keyframes(clip, frames, keyframes, start.world_from_camera[frames], trusted, weights)
    poses = anchor.bridge(clip, frames, keys)
    normals = np.concatenate([(k.normals.reshape(-1, 3)[k.scan.pixel_index]) @ p[:3, :3].T for k, p in zip(keyframes, keys, strict=True)])
    points = np.concatenate([rigid.apply(p, k.scan.points_camera) for k, p in zip(keyframes, keys, strict=True)])
    known = np.abs(normals).sum(1) > 0
    if known.sum() < LEAST_POINTS:
        raise _no_surface(clip)
    upright_from_world, gravity = anchor.upright(clip, poses, points[known], normals[known])
    mesh = fuse.fuse(clip, frames, upright_from_world @ poses, fusion)
    if len(mesh.faces) < 100:
        raise _no_surface(clip)
    poses, gap = fuse.align_frames(clip, mesh, upright_from_world @ poses, fusion, weights)
    mesh = fuse.clean(fuse.fuse(clip, np.arange(len(clip)), poses, fusion), workspace, fusion.island_faces)
    log(f"{len(mesh.faces)} faces; median gap of depth from the surface {np.nanmedian(gap) * 100:.1f} cm")
    made = Template(
        mesh=mesh,
        features=fuse.vertex_features(clip, features, mesh, poses, fusion.feature_frames),
        world_from_camera=poses,
        registered=np.nan_to_num(gap, nan=np.inf) < 0.1,
        gap_m=gap,
        start=start,
        keyframes=len(frames),
        reprojection_px=None if sparse is None else sparse.reprojection_px,
        gravity=gravity,
        floor_m=floor_height(mesh),
        scale=clip.scale,
    )
    return made, sparse


def _no_surface(clip: Clip) -> InputError:
    return InputError("MAP-002", "depth fused to no surface", str(clip.folder), "check that the recording has LiDAR depth within 4 m")


def floor_height(mesh: Mesh) -> float:
    """Return the height below which only a twentieth of the upward-facing surface lies."""
    up = mesh.vertex_normals()[:, 1] > 0.9
    return float(np.quantile(mesh.vertices[up, 1], 0.05)) if up.any() else float(mesh.vertices[:, 1].min())


def write_model(sparse: Sparse | None, world_from_camera: Float[np.ndarray, "frame 4 4"], folder: Path) -> None:
    """Write COLMAP's model as text, moved into the world by the similarity that best takes its camera centres there."""
    folder.mkdir()
    if sparse is None:
        (folder / "README.txt").write_text("COLMAP found no model in this walk-through.\n")
        return
    world_from_model = pycolmap.estimate_sim3d(sparse.model_from_camera[:, :3, 3], world_from_camera[sparse.frame][:, :3, 3])
    if world_from_model is not None:
        sparse.reconstruction.transform(world_from_model)
    sparse.reconstruction.write_text(folder)
