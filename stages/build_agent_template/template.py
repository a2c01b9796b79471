"""From a turnaround to the animal's canonical surface, bones and cameras."""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float

from pipeline.core.errors import InputError
from pipeline.data.clips import Clip, Masks
from pipeline.data.features import STRIDE_PX
from pipeline.fields.skinning import skinning_weights
from pipeline.geometry import rigid, subsampling
from pipeline.geometry.meshes import Mesh, RayCaster
from pipeline.metrics.silhouettes import silhouette_iou
from stages.build_agent_template import appearance
from stages.build_agent_template.canonical import Bones, find_heading, fit_bones
from stages.build_agent_template.config import Config
from stages.build_agent_template.fuse import fuse
from stages.build_agent_template.poses import register_turnaround

MIN_FRAMES = 10
"""least frames that show the animal"""


@dataclass(frozen=True)
class CanonicalTemplate:
    """The canonical animal (agent frame, meters) and the turnaround's cameras around it."""

    mesh: Mesh
    features: Float[np.ndarray, "vertex 16"]
    bones: Bones
    weights: Float[np.ndarray, "vertex bone"]
    agent_from_camera: Float[np.ndarray, "frame 4 4"]
    """NaN where the animal is not in view"""
    head_share: float
    elongation: float
    residual_m: float
    coverage_deg: float
    """angle around the animal that the cameras cover"""
    silhouette_iou: Float[np.ndarray, "view"]
    """of the surface with the masks of some frames; NaN where the animal is small"""


def build(
    clip: Clip,
    masks: Masks,
    features: Float[np.ndarray, "frame height width 16"],
    config: Config,
    rng: np.random.Generator,
) -> CanonicalTemplate:
    """Build the template from one turnaround. Raises InputError AGT-001 if too few frames show the animal."""
    if masks.visible.sum() < MIN_FRAMES:
        what = f"the animal is seen in {int(masks.visible.sum())} frames"
        remedy = "circle the resting animal once, the whole of it in view"
        raise InputError("AGT-001", what, str(masks.folder), remedy)
    turnaround = register_turnaround(clip, masks)
    body = fuse(clip, masks, turnaround, config.voxel_m, config.vertices)
    heading = find_heading(body.inside_world, turnaround.ground, config.turn_deg)
    agent_from_world = rigid.inverse(heading.world_from_agent)
    vertices = rigid.apply(agent_from_world, body.mesh.vertices.astype(float)).astype(np.float32)
    mesh = Mesh(vertices, body.mesh.faces)
    bones = fit_bones(rigid.apply(agent_from_world, body.inside_world), body.voxel_m, config.bones, rng)
    parts = (vertices, bones.agent_from_bone_rest, bones.bone_scale_m)
    surface, rest, scale = (torch.from_numpy(np.asarray(part, np.float32)) for part in parts)
    weights = skinning_weights(surface, rest, scale)
    cameras = agent_from_world @ turnaround.world_from_camera
    seen = np.flatnonzero(masks.visible)
    views = subsampling.some(seen, config.views)
    weight, pixel = appearance.visibility(mesh, cameras[views], clip.intrinsics[views], clip.color_size)
    on_mask = [appearance.on_mask(at, masks[view]) for at, view in zip(pixel, views, strict=True)]
    weight = weight * np.stack(on_mask)
    color = appearance.average_views(mesh.vertices, weight, pixel, [clip.color(view) for view in views], 1)
    vertex_features = appearance.average_views(mesh.vertices, weight, pixel, list(features[views]), STRIDE_PX)
    vertex_features /= np.maximum(np.linalg.norm(vertex_features, axis=1, keepdims=True), 1e-9)
    mesh = Mesh(mesh.vertices, mesh.faces, np.round(color).astype(np.uint8))
    caster = RayCaster(mesh)
    silhouettes = [silhouette_iou(clip, masks, caster, view, cameras[view]) for view in views.tolist()]
    cameras[~masks.visible] = np.nan
    return CanonicalTemplate(
        mesh,
        vertex_features,
        bones,
        weights.numpy(),
        cameras,
        heading.head_share,
        heading.elongation,
        turnaround.odometry_fit.residual_m,
        coverage_deg(cameras[seen]),
        np.array(silhouettes),
    )


def coverage_deg(agent_from_camera: Float[np.ndarray, "frame 4 4"]) -> float:
    """Return 360 degrees minus the widest gap between the cameras' directions around the animal."""
    angle = np.sort(np.degrees(np.arctan2(agent_from_camera[:, 0, 3], agent_from_camera[:, 2, 3])))
    return float(360 - np.diff(np.r_[angle, angle[0] + 360]).max())
