"""Build the optimization problem: rays of all videos, fields and their boxes, initial motion."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from pipeline.data.clips import Clip, Masks
from pipeline.data.motion import MotionTable, gaps_s
from pipeline.fields.fields import ArticulatedBody, Field, FieldShape
from pipeline.fields.fused_depth import FusedGeometry
from pipeline.fields.limbs import KinematicTree
from pipeline.geometry import rigid
from pipeline.geometry.meshes import Mesh
from pipeline.geometry.size import body_length_m
from stages.reconstruct.config import FieldSizes
from stages.reconstruct.problem import (
    Joints,
    Problem,
    RaysByFrame,
    TemplateSurface,
    frame_table,
    prior_precision,
    stretch_table,
)
from stages.reconstruct.rays import RayStore, Views, join

MIN_CONFIDENCE = 0.1
"""frames whose camera is less certain give no rays"""
DOUBTFUL_ROOT = 0.4
"""roots with lower confidence may be replaced as outliers"""
OUTLIER_ROOT = 0.5
"""if they are farther than this, body lengths, from the interpolation between confident ones"""
OUTLIER_GAP_S = 3.0
"""and those are at most this far away in time: over longer gaps interpolation is no better"""
OUTLIER_MASK_WEIGHT = 0.05
"""weight of the masks of outlier frames: most of them show something else"""
WHOLE_QUANTILE = 0.8
"""quantile of the masks' areas that stands for the whole animal in view"""
WHOLE_SHARE = 0.6
"""masks count fully from this share of that area on, as seen from one meter"""
MIN_MASK_WEIGHT = 0.03
"""lower bound of that weight: where the animal is occluded, neighboring frames constrain it better"""
PRECISION_BY_PICTURES = 20.0
"""prior precision of roots registered without depth: masks without thin parts push them 2 to 7 cm away"""
GRID_CHANNELS = 4
"""channels of each grid"""
KNOT_FRAMES = 10
"""frames between the knots of camera corrections: registration leaves slow drift, not jitter"""
SCENE_TRUNCATION_M = 0.08
"""the signed distance of a scene learned at measured depth saturates here"""
SCENE_MARGIN_M, AGENT_MARGIN = 0.2, 0.2
"""space around all that was measured, meters, and around the agent template, body lengths"""
SOLID_START_M, FREE_START_M = -0.03, 0.1
"""initial signed distance: the scene starts solid and is carved, the agent starts as free space"""
BOX_QUANTILE = 0.002
"""share of the measured points outside the box on each side of each axis: stray depth"""

Corner = tuple[float, float, float]


@dataclass(frozen=True)
class RegisteredVideo:
    """One video's poses from the templates or from registration, and its rays."""

    id: str
    timestamp_s: Float[np.ndarray, "frame"]
    world_from_camera: Float[np.ndarray, "frame 4 4"]
    """NaN where unknown"""
    world_from_agent: Float[np.ndarray, "frame 4 4"]
    """NaN where unknown"""
    confidence: Float[np.ndarray, "frame"]
    agent_visible: Bool[np.ndarray, "frame"]
    camera_free: bool
    """False holds the camera: templates"""
    has_scene: bool
    """False for the turnaround: its world is the agent"""
    store: RayStore
    clip: Clip | None = None
    """its frames; None if only the rays are needed"""
    masks: Masks | None = None
    """its masks; None if there is no agent"""
    agent_confidence: Float[np.ndarray, "frame"] | None = None
    """probability that the agent's root is correct, 0..1; None: certain"""

    @property
    def certain_cameras(self) -> Bool[np.ndarray, "frame"]:
        """Return which frames have a known camera of sufficient confidence."""
        return np.isfinite(self.world_from_camera).all((1, 2)) & (self.confidence >= MIN_CONFIDENCE)


@dataclass(frozen=True)
class AgentTemplate:
    """The agent template."""

    mesh: Mesh
    feature: Float[np.ndarray, "vertex 16"]
    agent_from_bone_rest: Float[np.ndarray, "bone 4 4"]
    bone_scale_m: Float[np.ndarray, "bone 3"]


def build(
    videos: Sequence[RegisteredVideo],
    template: AgentTemplate,
    sizes: FieldSizes,
    seed: int,
    device: str,
    fused: FusedGeometry | None = None,
    scratch: Path | None = None,
    floor_m: float = -math.inf,
    rendered: bool = False,
) -> Problem:
    """Build the optimization problem. Videos with a scene come first, in the order of their codes.

    Args:
        fused: the scene's fixed geometry; None: its field learns it.
        scratch: folder of unnamed files with the measurements; None: where temporary files stand.
        floor_m: height of the floor in the world.
        rendered: the scene is learned by differentiable rendering alone; see `scene_field`.
    """
    videos = scene_first(videos)
    torch.manual_seed(seed)
    height, width = (max(video.store.views.depth.shape[axis] for video in videos) for axis in (1, 2))
    store = join((usable_rays(video) for video in videos), scratch, (height, width))
    lengths = [len(video.timestamp_s) for video in videos]
    camera = [interpolated(video.timestamp_s, video.world_from_camera) for video in videos]
    length_m = body_length_m(template.mesh)
    roots, inliers = zip(*(replace_outliers(video, length_m) for video in videos), strict=True)
    root = [interpolated(video.timestamp_s, root) for video, root in zip(videos, roots, strict=True)]
    camera, root = (torch.from_numpy(np.concatenate(poses)) for poses in (camera, root))
    has_root = torch.from_numpy(np.isfinite(np.concatenate(roots)).all((1, 2)))
    trust = torch.from_numpy(np.where(np.concatenate(inliers), 1.0, OUTLIER_MASK_WEIGHT)).float()
    vertices, margin_m = template.mesh.vertices, AGENT_MARGIN * length_m
    low, high = corner(vertices.min(0) - margin_m), corner(vertices.max(0) + margin_m)
    fine = sizes.agent_voxel_m
    agent_shape = FieldShape(low, high, fine, GRID_CHANNELS, sizes.width, encoding=sizes.encoding)
    rest = torch.from_numpy(template.agent_from_bone_rest).float()
    by_frame = RaysByFrame.of(store.agent.frame, sum(lengths))
    usable_frames = torch.nonzero(has_root & store.views.agent_seen & (by_frame.count > 0))[:, 0]
    has_scene = torch.tensor([video.has_scene for video in videos])[frame_table(lengths)]
    free = [video.camera_free for video in videos]
    mapped = torch.tensor([video.camera_free and bool(video.clip and video.clip.mapped) for video in videos])
    motion = MotionTable(camera, root, rest, lengths, free, KNOT_FRAMES)
    body = ArticulatedBody(rest, torch.from_numpy(template.bone_scale_m).float(), agent_shape)
    surface = TemplateSurface.of(template.mesh, template.feature, np.random.default_rng(seed))
    with torch.no_grad():
        skin = body.weights(surface.points)
        joints, tree = Joints.of(surface.points, skin), KinematicTree.of(surface.points, skin, rest)
    problem = Problem(
        store=store,
        scene=scene_field(videos, sizes, fused, rendered),
        agent=Field(agent_shape, free_m=FREE_START_M),
        body=body,
        motion=motion,
        video=frame_table(lengths),
        stretch=stretch_table([video.timestamp_s for video in videos]),
        has_scene=has_scene,
        surface=surface,
        joints=joints,
        tree=tree,
        agent_frames=usable_frames,
        agent_rays=by_frame,
        trust=trust * mask_weights(store.views),
        root_precision=torch.where(mapped, PRECISION_BY_PICTURES, 1.0)[frame_table(lengths)],
        camera_precision=prior_precision(motion, np.concatenate([video.confidence for video in videos])),
        floor_m=floor_m,
    )
    return problem if device == "cpu" else to_device(problem, device)


def corner(point: Float[np.ndarray, "3"]) -> Corner:
    """Return a corner of a box as plain numbers, meters."""
    x, y, z = (float(value) for value in point)
    return x, y, z


def scene_field(
    videos: Sequence[RegisteredVideo], sizes: FieldSizes, fused: FusedGeometry | None, rendered: bool = False
) -> Field:
    """Return the scene's untrained field in the box of what was measured.

    With ``rendered`` its signed distance starts as the distance to the box's walls and never saturates, so
    that rendering finds surfaces and the eikonal loss holds everywhere. Otherwise it starts solid and
    saturates at `SCENE_TRUNCATION_M`, for losses at measured depth.
    """
    truncation_m = fused.truncation_m if fused else None if rendered else SCENE_TRUNCATION_M
    shape = FieldShape(
        *measured_box(videos),
        sizes.scene_voxel_m,
        GRID_CHANNELS,
        sizes.width,
        sum(video.has_scene for video in videos) if sizes.code_channels else 0,
        sizes.code_channels,
        truncation_m=truncation_m,
        encoding=sizes.encoding,
        starts_as_box=rendered and not fused,
    )
    return Field(shape, free_m=SOLID_START_M, fused=fused)


def scene_first(videos: Sequence[RegisteredVideo]) -> list[RegisteredVideo]:
    """Return the videos in the order of frames and codes: those with a scene first."""
    return sorted(videos, key=lambda video: not video.has_scene)


def scene_ids(videos: Sequence[RegisteredVideo]) -> tuple[str, ...]:
    """Return the ids in the order of the scene's codes."""
    return tuple(video.id for video in scene_first(videos) if video.has_scene)


def usable_rays(video: RegisteredVideo) -> RayStore:
    """Drop the rays of frames whose camera is unknown or of low confidence."""
    good, store = torch.from_numpy(video.certain_cameras), video.store
    scene, agent = (rays.at(torch.nonzero(good[rays.frame])[:, 0]) for rays in (store.scene, store.agent))
    return RayStore(scene, agent, store.views)


def replace_outliers(
    video: RegisteredVideo, length_m: float
) -> tuple[Float[np.ndarray, "frame 4 4"], Bool[np.ndarray, "frame"]]:
    """Replace low-confidence roots of an animal of ``length_m`` far from the interpolation of confident ones.

    Returns:
        The roots, world from agent (NaN where unknown), and which frames are inliers.
    """
    root, time = video.world_from_agent.copy(), video.timestamp_s
    known = np.all(np.isfinite(root), axis=(1, 2))
    doubted = video.agent_confidence is not None and video.agent_confidence < DOUBTFUL_ROOT
    certain = known & ~np.asarray(doubted)
    inlier = np.ones(len(root), bool)
    if certain.sum() < 2:
        return root, inlier
    doubtful = np.flatnonzero(known & ~certain & (gaps_s(time, certain) <= OUTLIER_GAP_S))
    between = rigid.interpolate(time[certain], root[certain], time[doubtful])
    far = np.linalg.norm(root[doubtful, :3, 3] - between[:, :3, 3], axis=1) > OUTLIER_ROOT * length_m
    root[doubtful[far]], inlier[doubtful[far]] = between[far], False
    return root, inlier


def mask_weights(views: Views) -> Float[Tensor, "frame"]:
    """Return each frame's mask weight, 0..1: how much of the animal it shows, by area at its distance."""
    area = torch.zeros(len(views.depth))
    for frame in torch.nonzero(views.agent_seen)[:, 0].tolist():
        inside = views.outside_px[frame] < 0
        depth = views.depth[frame][inside].float()
        if (depth > 0).any():
            area[frame] = inside.sum() * (depth[depth > 0].median() / views.intrinsics[frame, 0, 0]) ** 2
    if not (area > 0).any():
        return torch.ones_like(area)
    share = area / area[area > 0].quantile(WHOLE_QUANTILE)
    return torch.where(area > 0, (share / WHOLE_SHARE).clamp(MIN_MASK_WEIGHT, 1), 1.0)


def interpolated(
    timestamp_s: Float[np.ndarray, "frame"], a_from_b: Float[np.ndarray, "frame 4 4"]
) -> Float[np.ndarray, "frame 4 4"]:
    """Interpolate unknown poses between known ones; all unknown gives identities."""
    known = np.isfinite(a_from_b).all((1, 2))
    if not known.any():
        return np.tile(np.eye(4), (len(a_from_b), 1, 1))
    return rigid.interpolate(timestamp_s[known], a_from_b[known], timestamp_s)


def measured_box(videos: Sequence[RegisteredVideo], max_points: int = 200_000) -> tuple[Corner, Corner]:
    """Return the box (world, meters) of about ``max_points`` measured points, without strays, and cameras."""
    step = max(7, sum(len(video.store.scene) for video in videos) // max_points)
    stores = (usable_rays(video).scene for video in videos)
    rays = [store.at(torch.nonzero(store.depth > 0)[:, 0][::step]) for store in stores]
    points, centers = [], []
    for video, some in zip(videos, rays, strict=True):
        poses, frame = video.world_from_camera, some.frame.numpy()
        points_camera = (some.direction * some.depth[:, None]).numpy()
        points.append(rigid.apply(poses[frame], points_camera[:, None])[:, 0])
        centers.append(poses[np.unique(frame), :3, 3])
    points, centers = np.concatenate(points), np.concatenate(centers)
    low = np.minimum(np.quantile(points, BOX_QUANTILE, axis=0), centers.min(0)) - SCENE_MARGIN_M
    high = np.maximum(np.quantile(points, 1 - BOX_QUANTILE, axis=0), centers.max(0)) + SCENE_MARGIN_M
    return corner(low), corner(high)


def to_device(value: Any, device: str) -> Any:
    """Move modules, tensors and dataclasses of them to a device; return other values unchanged."""
    if isinstance(value, Tensor | nn.Module):
        return value.to(device)
    if not is_dataclass(value) or isinstance(value, type):
        return value
    parts = {part.name: to_device(getattr(value, part.name), device) for part in fields(value)}
    return replace(value, **parts)
