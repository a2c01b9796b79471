"""A mesh that the recording brings along, such as Polycam's own, in place of a fused one.

It is taken when the depth of the walk-through says that it stands where the cameras saw it, in metres; what no frame saw
is cut, so that holes stay holes although apps like to close them, and the frames lend it their colours.
"""

from dataclasses import dataclass

import numpy as np
import trimesh
from jaxtyping import Bool, Float

from pipeline.files.clips import Clip
from pipeline.progress import log
from pipeline.space import cameras, rigid
from pipeline.space.meshes import Mesh, RayCaster, render_view
from stages.build_scene_template import anchor, fuse
from stages.build_scene_template.fuse import FuseOptions
from stages.build_scene_template.refine import RefineOptions
from stages.build_scene_template.template import Template, floor_height


@dataclass(frozen=True)
class GivenOptions:
    """When a mesh that the recording brings along is taken."""

    take: bool = True
    """Whether it is looked at at all; otherwise the template is fused from depth."""
    edge_m: float = 0.05
    """Longer edges are divided, so that vertices can carry colours, metres."""
    most_off: float = 0.03
    """Relative difference of its scale from measured depth beyond which it is not taken."""
    most_gap_m: float = 0.05
    """Median distance of measured depth from it beyond which it is not taken, metres."""
    least_agree: float = 0.7
    """Share of measured depth that must meet it."""
    seen_within_m: float = 0.08
    """A vertex was seen where measured depth is this close to its distance, metres."""
    views: int = 60
    """Frames that colour it and say what was seen, spread evenly."""


def build(
    clip: Clip,
    features: Float[np.ndarray, "frame height width channel"],
    mesh: Mesh,
    options: GivenOptions,
    weights: RefineOptions,
    fusion: FuseOptions,
) -> Template | None:
    """Make the template of a mesh that stands in the odometry's world; None where measured depth refutes it."""
    odometry = clip.odometry_from_camera
    if odometry is None:
        return None
    vertices, faces = trimesh.remesh.subdivide_to_size(mesh.vertices, mesh.faces, options.edge_m, max_iter=12)
    fine = Mesh(vertices.astype(np.float32), faces.astype(np.int32), np.full((len(vertices), 3), 128, np.uint8))
    upright_from_world, gravity = anchor.upright(clip, odometry, fine.vertices.astype(float), fine.vertex_normals())
    fine = Mesh(rigid.apply(upright_from_world, fine.vertices.astype(float)).astype(np.float32), fine.faces, fine.color)
    scale, agree = depth_against(clip, fine, upright_from_world @ odometry, options.seen_within_m)
    poses, gap = fuse.align_frames(clip, fine, upright_from_world @ odometry, fusion, weights)
    off_m = float(np.nanmedian(gap)) if np.isfinite(gap).any() else np.inf
    if not abs(scale - 1) < options.most_off or agree < options.least_agree or off_m > options.most_gap_m:
        log(f"the recording's own mesh is not taken, but one is fused: depth over mesh {scale:.3f}, {agree:.0%} of the depth meets it")
        return None
    seen, color = seen_and_colored(clip, fine, poses, options)
    kept = seen[fine.faces].any(1)
    used, cut = np.unique(fine.faces[kept], return_inverse=True)
    own = Mesh(fine.vertices[used], cut.reshape(-1, 3).astype(np.int32), color[used])
    log(f"the recording's own mesh: {100 * (1 - kept.mean()):.0f} % of it was never seen and is cut; {100 * off_m:.1f} cm from depth")
    return Template(
        mesh=own,
        features=fuse.vertex_features(clip, features, own, poses, fusion.feature_frames),
        world_from_camera=poses,
        registered=np.nan_to_num(gap, nan=np.inf) < 0.1,
        gap_m=gap,
        start=anchor.Trajectory(poses, "odometry", "", np.arange(len(clip)), None, None, {}),
        keyframes=len(clip),
        reprojection_px=None,
        gravity=gravity,
        floor_m=floor_height(own),
        scale=clip.scale,
        own_mesh=True,
    )


def depth_against(
    clip: Clip, mesh: Mesh, world_from_camera: Float[np.ndarray, "frame 4 4"], within_m: float, views: int = 10
) -> tuple[float, float]:
    """Return the median of measured depth over the mesh's distance along the same rays, and the share that meets it."""
    caster, ratios, meets = RayCaster(mesh), [], []
    for frame in np.unique(np.linspace(0, len(clip) - 1, views).astype(int)):
        depth = clip.depth(int(frame))[::4, ::4]
        intrinsics = cameras.scale_intrinsics(clip.depth_intrinsics[frame], clip.depth_size, depth.shape)
        drawn = render_view(caster, world_from_camera[frame], intrinsics, *depth.shape)[0]
        both = (depth > 0) & (drawn > 0)
        ratios.append(depth[both] / drawn[both])
        meets.append((np.abs(depth - drawn) < within_m)[depth > 0])
    ratio, met = np.concatenate(ratios), np.concatenate(meets)
    return (float(np.median(ratio)), float(met.mean())) if len(ratio) else (np.nan, 0.0)


def seen_and_colored(
    clip: Clip, mesh: Mesh, world_from_camera: Float[np.ndarray, "frame 4 4"], options: GivenOptions
) -> tuple[Bool[np.ndarray, "vertex"], np.ndarray]:
    """Return which vertices some frame's depth confirms, and the mean colour that those frames give them."""
    total, weight = np.zeros((len(mesh.vertices), 3)), np.zeros(len(mesh.vertices))
    for frame in np.unique(np.linspace(0, len(clip) - 1, options.views).astype(int)):
        local = rigid.apply(rigid.inverse(world_from_camera[frame]), mesh.vertices.astype(float))
        depth, color = clip.depth(int(frame)), clip.color(int(frame))
        in_depth, z = cameras.project(local, clip.depth_intrinsics[frame])
        in_color, _ = cameras.project(local, clip.intrinsics[frame])
        inside = np.flatnonzero((z > 0.1) & _within(in_depth, depth.shape) & _within(in_color, color.shape[:2]))
        column, row = np.floor(in_depth[inside]).astype(int).T
        inside = inside[np.abs(depth[row, column] - z[inside]) < options.seen_within_m]
        column, row = np.floor(in_color[inside]).astype(int).T
        total[inside] += color[row, column] / z[inside, None]
        weight[inside] += 1 / z[inside]
    mean = total / np.maximum(weight, 1e-9)[:, None]
    return weight > 0, np.where(weight[:, None] > 0, mean.round(), 128).astype(np.uint8)


def _within(pixel: Float[np.ndarray, "vertex 2"], size: tuple[int, int]) -> Bool[np.ndarray, "vertex"]:
    return (pixel >= 0).all(1) & (pixel[:, 0] < size[1]) & (pixel[:, 1] < size[0])
