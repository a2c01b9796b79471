"""A mesh that the recording brings along, such as Polycam's own, in place of a fused one.

It is used when the walk-through's depth confirms its place and scale. Parts that no frame saw are cut (apps
close holes), and the frames colour it.
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
from stages.build_scene_template.template import REGISTERED_WITHIN_M, SceneTemplate, floor_height

EDGE_M, SUBDIVISIONS = 0.05, 12
"""Longer edges are divided, at most so often, so that vertices can carry colours, metres."""
MAX_SCALE_ERROR, MAX_GAP_M, MIN_AGREE = 0.03, 0.05, 0.7
"""Bounds on its relative scale error, its median distance from depth (metres) and the share of depth that
meets it; Polycam's meshes have 1 %, 2 cm and 0.85."""
SEEN_WITHIN_M, NEAREST_M = 0.08, 0.1
"""A vertex was seen where depth agrees within the first, metres; depth below the second is none."""
SCALE_VIEWS, SCALE_STRIDE_PX, COLOR_VIEWS = 10, 4, 60
"""Frames and pixels that measure the scale, and frames that colour it and vote on what was seen."""


def build(
    clip: Clip, features: Float[np.ndarray, "frame height width channel"], mesh: Mesh, config: Config
) -> SceneTemplate | None:
    """Make the template of a mesh that stands in the odometry's world; None where depth refutes it."""
    odometry = clip.odometry_from_camera
    if odometry is None:
        return None
    parts = trimesh.remesh.subdivide_to_size(mesh.vertices, mesh.faces, EDGE_M, max_iter=SUBDIVISIONS)
    vertices, faces = parts[0].astype(np.float32), parts[1].astype(np.int32)
    points, normals = vertices.astype(float), Mesh(vertices, faces).vertex_normals()
    upright_from_world, gravity = anchor.upright(clip, odometry, points, normals)
    upright = rigid.apply(upright_from_world, points).astype(np.float32)
    fine = Mesh(upright, faces, np.full((len(vertices), 3), 128, np.uint8))
    scale, agree = depth_against(clip, fine, upright_from_world @ odometry, SEEN_WITHIN_M)
    poses, gap = fuse.align_frames(clip, fine, upright_from_world @ odometry, config.fusion)
    off_m = float(np.nanmedian(gap)) if np.isfinite(gap).any() else np.inf
    if not abs(scale - 1) < MAX_SCALE_ERROR or agree < MIN_AGREE or off_m > MAX_GAP_M:
        measured = f"depth / mesh {scale:.3f}, {agree:.0%} of depth agrees"
        log(f"the recording's own mesh is refuted, one is fused instead: {measured}")
        return None
    seen, color = seen_and_colored(clip, fine, poses)
    observed = seen[fine.faces].any(1)
    used, cut = np.unique(fine.faces[observed], return_inverse=True)
    own = Mesh(fine.vertices[used], cut.reshape(-1, 3).astype(np.int32), color[used])
    unseen = f"{1 - observed.mean():.0%} of it was never seen and is cut"
    log(f"the recording's own mesh: {unseen}; {100 * off_m:.1f} cm from depth")
    return SceneTemplate(
        mesh=own,
        features=fuse.vertex_features(clip, features, own, poses, config.fusion.feature_frames),
        world_from_camera=poses,
        registered=np.nan_to_num(gap, nan=np.inf) < REGISTERED_WITHIN_M,
        gap_m=gap,
        start=anchor.InitialTrajectory(poses, "odometry", "", np.arange(len(clip)), None, None, {}),
        keyframe=np.ones(len(clip), bool),
        reprojection_px=None,
        gravity=gravity,
        floor_m=floor_height(own),
        scale=clip.scale,
        own_mesh=True,
    )


def depth_against(
    clip: Clip, mesh: Mesh, world_from_camera: Float[np.ndarray, "frame 4 4"], within_m: float
) -> tuple[float, float]:
    """Return the median of depth over the mesh's distance along the rays, and the share that meets it."""
    caster, ratios, meets = RayCaster(mesh), [], []
    for frame in subsampling.evenly(len(clip), SCALE_VIEWS):
        depth = clip.depth(int(frame))[::SCALE_STRIDE_PX, ::SCALE_STRIDE_PX]
        intrinsics = cameras.scale_intrinsics(clip.depth_intrinsics[frame], clip.depth_size, depth.shape)
        drawn = render_view(caster, world_from_camera[frame], intrinsics, *depth.shape)[0]
        both = (depth > 0) & (drawn > 0)
        ratios.append(depth[both] / drawn[both])
        meets.append((np.abs(depth - drawn) < within_m)[depth > 0])
    ratio, met = np.concatenate(ratios), np.concatenate(meets)
    return (float(np.median(ratio)), float(met.mean())) if len(ratio) else (np.nan, 0.0)


def seen_and_colored(
    clip: Clip, mesh: Mesh, world_from_camera: Float[np.ndarray, "frame 4 4"]
) -> tuple[Bool[np.ndarray, "vertex"], UInt8[np.ndarray, "vertex 3"]]:
    """Return which vertices some frame's depth confirms, and the mean colour that those frames give them."""
    total, weight = np.zeros((len(mesh.vertices), 3)), np.zeros(len(mesh.vertices))
    for frame in subsampling.evenly(len(clip), COLOR_VIEWS):
        local = rigid.apply(rigid.inverse(world_from_camera[frame]), mesh.vertices.astype(float))
        depth, color = clip.depth(int(frame)), clip.color(int(frame))
        in_depth, z = cameras.project(local, clip.depth_intrinsics[frame])
        in_color, _ = cameras.project(local, clip.intrinsics[frame])
        inside = cameras.in_picture(in_depth, z, depth.shape, NEAREST_M)
        inside = np.flatnonzero(inside & cameras.in_picture(in_color, z, color.shape[:2]))
        column, row = np.floor(in_depth[inside]).astype(int).T
        inside = inside[np.abs(depth[row, column] - z[inside]) < SEEN_WITHIN_M]
        column, row = np.floor(in_color[inside]).astype(int).T
        total[inside] += color[row, column] / z[inside, None]
        weight[inside] += 1 / z[inside]
    mean = total / np.maximum(weight, 1e-9)[:, None]
    return weight > 0, np.where(weight[:, None] > 0, mean.round(), 128).astype(np.uint8)
