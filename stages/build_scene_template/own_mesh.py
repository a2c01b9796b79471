"""Use the mesh that comes with a recording, such as Polycam's, in place of a fused one.

The walk-through's depth must confirm its pose and scale. Faces that no frame saw are removed (apps fill
holes), and vertices are colored by the frames.
"""

import numpy as np
import trimesh
from jaxtyping import Bool, Float, UInt8

from pipeline.core.progress import log
from pipeline.data.clips import Clip
from pipeline.geometry import cameras, rigid, subsampling
from pipeline.geometry.meshes import Mesh, RayCaster, render_view
from stages.build_scene_template import anchor, fuse
from stages.build_scene_template.config import Config
from stages.build_scene_template.template import SceneTemplate, floor_height

EDGE_M, SUBDIVISIONS = 0.05, 12
"""Edge length (meters) to which edges are subdivided, in at most so many iterations, for vertex colors."""
MAX_SCALE_ERROR, MAX_GAP_M, MIN_AGREE = 0.03, 0.05, 0.7
"""Bounds on relative scale error, median depth residual (meters) and share of depth that agrees; Polycam's
meshes have 1 %, 2 cm and 0.85."""
SEEN_WITHIN_M, MIN_DEPTH_M = 0.08, 0.1
"""Depth agreement of a seen vertex, and least valid depth, meters."""
SCALE_VIEWS, SCALE_STRIDE_PX, COLOR_VIEWS = 10, 4, 60
"""Frames and pixel stride for measuring scale; frames for coloring and visibility."""


def build(
    clip: Clip, features: Float[np.ndarray, "frame height width channel"], mesh: Mesh, config: Config
) -> SceneTemplate | None:
    """Build the template from a mesh in the odometry's world frame; None if depth contradicts it."""
    odometry = clip.odometry_from_camera
    if odometry is None:
        return None
    subdivided = trimesh.remesh.subdivide_to_size(mesh.vertices, mesh.faces, EDGE_M, max_iter=SUBDIVISIONS)
    vertices, faces = subdivided[0].astype(np.float32), subdivided[1].astype(np.int32)
    points, normals = vertices.astype(float), Mesh(vertices, faces).vertex_normals()
    upright_from_world, gravity = anchor.upright(clip, odometry, points, normals)
    upright = rigid.apply(upright_from_world, points).astype(np.float32)
    fine = Mesh(upright, faces, np.full((len(vertices), 3), 128, np.uint8))
    scale, agree = compare_depth(clip, fine, upright_from_world @ odometry, SEEN_WITHIN_M)
    poses, gap, fit = fuse.align_frames(clip, fine, upright_from_world @ odometry, config.fusion)
    median_gap_m = float(np.nanmedian(gap)) if np.isfinite(gap).any() else np.inf
    if not abs(scale - 1) < MAX_SCALE_ERROR or agree < MIN_AGREE or median_gap_m > MAX_GAP_M:
        measured = f"depth / mesh {scale:.3f}, {agree:.0%} of depth agrees"
        log(f"the recording's own mesh is rejected and one is fused instead: {measured}")
        return None
    registered, (seen, color) = fuse.registered(fit), seen_and_colored(clip, fine, poses)
    shown = subsampling.some(np.flatnonzero(registered), config.fusion.feature_frames)
    observed = seen[fine.faces].any(1)
    used, new_index = np.unique(fine.faces[observed], return_inverse=True)
    visible_mesh = Mesh(fine.vertices[used], new_index.reshape(-1, 3).astype(np.int32), color[used])
    unseen = f"{1 - observed.mean():.0%} of its faces were never seen and are removed"
    log(f"the recording's own mesh: {unseen}; {100 * median_gap_m:.1f} cm from depth")
    return SceneTemplate(
        mesh=visible_mesh,
        features=fuse.vertex_features(clip, features, visible_mesh, poses, shown),
        world_from_camera=poses,
        registered=registered,
        gap_m=gap,
        start=anchor.InitialTrajectory(poses, "odometry", "", np.arange(len(clip)), None, {}),
        keyframe=np.ones(len(clip), bool),
        reprojection_px=None,
        gravity=gravity,
        floor_m=floor_height(visible_mesh),
        scale=clip.scale,
        own_mesh=True,
    )


def compare_depth(
    clip: Clip, mesh: Mesh, world_from_camera: Float[np.ndarray, "frame 4 4"], within_m: float
) -> tuple[float, float]:
    """Return the median ratio of measured to rendered depth, and the share of depth that agrees."""
    caster, ratios, agrees = RayCaster(mesh), [], []
    for frame in subsampling.evenly(len(clip), SCALE_VIEWS):
        depth = clip.depth(int(frame))[::SCALE_STRIDE_PX, ::SCALE_STRIDE_PX]
        intrinsics = cameras.scale_intrinsics(clip.depth_intrinsics[frame], clip.depth_size, depth.shape)
        rendered = render_view(caster, world_from_camera[frame], intrinsics, *depth.shape)[0]
        both = (depth > 0) & (rendered > 0)
        ratios.append(depth[both] / rendered[both])
        agrees.append((np.abs(depth - rendered) < within_m)[depth > 0])
    ratio, agreed = np.concatenate(ratios), np.concatenate(agrees)
    return (float(np.median(ratio)), float(agreed.mean())) if len(ratio) else (np.nan, 0.0)


def seen_and_colored(
    clip: Clip, mesh: Mesh, world_from_camera: Float[np.ndarray, "frame 4 4"]
) -> tuple[Bool[np.ndarray, "vertex"], UInt8[np.ndarray, "vertex 3"]]:
    """Return which vertices some frame's depth confirms, and their mean color, weighted by 1 / depth."""
    total, weight = np.zeros((len(mesh.vertices), 3)), np.zeros(len(mesh.vertices))
    for frame in subsampling.evenly(len(clip), COLOR_VIEWS):
        local = rigid.apply(rigid.inverse(world_from_camera[frame]), mesh.vertices.astype(float))
        depth, color = clip.depth(int(frame)), clip.color(int(frame))
        measured = cameras.lookup_depth(depth, clip.depth_intrinsics[frame], local)
        pixel, z = cameras.project(local, clip.intrinsics[frame])
        inside = cameras.in_picture(pixel, z, color.shape[:2], MIN_DEPTH_M)
        inside = np.flatnonzero(inside & (np.abs(measured - z) < SEEN_WITHIN_M))
        total[inside] += color[cameras.pixel_index(pixel[inside])] / z[inside, None]
        weight[inside] += 1 / z[inside]
    mean = total / np.maximum(weight, 1e-9)[:, None]
    return weight > 0, np.where(weight[:, None] > 0, mean.round(), 128).astype(np.uint8)
