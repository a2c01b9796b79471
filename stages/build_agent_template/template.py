"""From a walk around the animal to its canonical surface, bones and the cameras around it."""

from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float

from pipeline.errors import InputError
from pipeline.files.clips import Clip, Masks
from pipeline.models.skinning import skinning_weights
from pipeline.space import rigid
from pipeline.space.meshes import Mesh
from pipeline.space.straightening import Straightening
from stages.build_agent_template import appearance
from stages.build_agent_template.bones import Bones, Skeleton, lay_bones
from stages.build_agent_template.canonical import find_heading
from stages.build_agent_template.fuse import Fusion, fuse
from stages.build_agent_template.poses import walk_around

LEAST_FRAMES = 10
FEATURE_STRIDE = 8
"""Colour pixels per feature cell."""


@dataclass(frozen=True)
class Options:
    """How the template is made; each table belongs to one file of this room."""

    turn_deg: float = 0.0
    """Turn the animal by so much, counterclockwise from above, when the turntable does not begin with its head's side: 180 where
    head and tail were mistaken for each other, 90 or -90 where its sides were taken for them."""
    straightening: Straightening = field(default_factory=lambda: Straightening(loops=5))
    """Drift of the phone's poses and its repair."""
    fusion: Fusion = field(default_factory=Fusion)
    """How the surface is made."""
    skeleton: Skeleton = field(default_factory=Skeleton)
    """How bones are laid."""
    views: int = 24
    """Frames whose colours and features are gathered."""


@dataclass(frozen=True)
class Template:
    """The canonical animal (agent frame, metres) and the turnaround's cameras around it."""

    mesh: Mesh
    features: Float[np.ndarray, "vertex 16"]
    bones: Bones
    weights: Float[np.ndarray, "vertex bone"]
    agent_from_camera: Float[np.ndarray, "frame 4 4"]
    """NaN where the animal is not in view"""
    head_share: float
    elongation: float
    residual_m: float
    around_deg: float
    """how much of the circle the cameras cover"""


def build(
    clip: Clip, masks: Masks, features: Float[np.ndarray, "frame height width 16"], options: Options, rng: np.random.Generator
) -> Template:
    """Build the template from one turnaround. Raises InputError AGT-001 when the animal is seen in too few frames."""
    if masks.visible.sum() < LEAST_FRAMES:
        raise InputError(
            "AGT-001",
            f"the animal is seen in {int(masks.visible.sum())} frames",
            str(masks.folder),
            "circle the resting animal once, the whole of it in view",
        )
    circle = walk_around(clip, masks, options.straightening)
    body = fuse(clip, masks, circle, options.fusion)
    heading = find_heading(body.inside_world, circle.ground, options.turn_deg)
    agent_from_world = rigid.inverse(heading.world_from_agent)
    mesh = Mesh(rigid.apply(agent_from_world, body.mesh.vertices.astype(float)).astype(np.float32), body.mesh.faces)
    bones = lay_bones(rigid.apply(agent_from_world, body.inside_world), body.voxel_m, options.skeleton, rng)
    weights = skinning_weights(
        *(torch.from_numpy(np.asarray(part, np.float32)) for part in (mesh.vertices, bones.agent_from_bone_rest, bones.bone_scale_m))
    )
    cameras = agent_from_world @ circle.world_from_camera
    seen = np.flatnonzero(masks.visible)
    views = seen[np.unique(np.linspace(0, len(seen) - 1, options.views).astype(int))]
    weight, pixel = appearance.visibility(mesh, cameras[views], clip.intrinsics[views], clip.color_size)
    weight = weight * np.stack([appearance.on_mask(at, masks[view]) for at, view in zip(pixel, views, strict=True)])
    color = appearance.gather(mesh.vertices, weight, pixel, [clip.color(view) for view in views], 1)
    vertex_features = appearance.gather(mesh.vertices, weight, pixel, features[views], FEATURE_STRIDE)
    vertex_features /= np.maximum(np.linalg.norm(vertex_features, axis=1, keepdims=True), 1e-9)
    mesh = Mesh(mesh.vertices, mesh.faces, np.round(color).astype(np.uint8))
    cameras[~masks.visible] = np.nan
    return Template(
        mesh,
        vertex_features,
        bones,
        weights.numpy(),
        cameras,
        heading.head_share,
        heading.elongation,
        circle.straightened.residual_m,
        covered_deg(cameras[seen]),
    )


def covered_deg(agent_from_camera: Float[np.ndarray, "frame 4 4"]) -> float:
    """Return 360 degrees less the widest gap between the cameras' directions around the animal."""
    angle = np.sort(np.degrees(np.arctan2(agent_from_camera[:, 0, 3], agent_from_camera[:, 2, 3])))
    return float(360 - np.diff(np.r_[angle, angle[0] + 360]).max())
