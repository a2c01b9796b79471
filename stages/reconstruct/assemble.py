"""Set the problem up: join the videos' rays, place the boxes of the fields, start the motion at the registered poses."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from pipeline.models.fields import Body, Field, FieldShape
from pipeline.models.fused import Fused
from pipeline.models.motion import MotionTable, gaps_s
from pipeline.space import rigid
from pipeline.space.meshes import Mesh
from stages.reconstruct.limbs import Limbs
from stages.reconstruct.problem import Joints, Problem, RaysByFrame, Surface, firmness, frame_table
from stages.reconstruct.rays import Source, Store, Views, join

USUAL = 0.8
"""quantile of the areas of masks that stands for the whole animal"""


@dataclass(frozen=True)
class Video:
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
    store: Store
    source: Source | None = None
    """its pictures; None where all that is wanted of them stands in the store"""
    agent_confidence: Float[np.ndarray, "frame"] | None = None
    """that the agent's root is right, 0..1; None: certain"""


@dataclass(frozen=True)
class Doubt:
    """Which registered roots are given up, doubtful ones far from where their neighbours in time have the agent, and what masks count."""

    least_confidence: float = 0.4
    """roots that are less certain may be given up"""
    farthest_m: float = 0.3
    """if they lie farther than this from between the certain ones"""
    longest_gap_s: float = 3.0
    """and those are no farther apart in time"""
    trust: float = 0.05
    """how much the masks of such frames still count: mostly they show something else"""
    whole_share: float = 0.6
    """a mask counts fully from this share of the area on that most of the animal's masks have, as if seen from one metre ..."""
    least_share: float = 0.03
    """... less below, but at least so much: where the animal hides, its neighbours in time know better"""


@dataclass(frozen=True)
class Template:
    """The agent template."""

    mesh: Mesh
    feature: Float[np.ndarray, "vertex 16"]
    agent_from_bone_rest: Float[np.ndarray, "bone 4 4"]
    bone_scale_m: Float[np.ndarray, "bone 3"]


@dataclass(frozen=True)
class Shapes:
    """Sizes of the fields."""

    scene_voxel_m: tuple[float, ...] = (0.32, 0.16, 0.08)
    """cells of the scene's grids"""
    agent_voxel_m: tuple[float, ...] = (0.06, 0.03, 0.015)
    """cells of the agent's grids"""
    grid_channels: int = 4
    """channels of each grid"""
    encoding: Literal["grid", "mlp"] = "grid"
    """what the fields read places from: grids, or the paper's plain network"""
    code_channels: int = 8
    """numbers of each video's code of the scene; 0 = one scene for all videos, without codes (baselines)"""
    width: int = 64
    """units of each head's hidden layer"""
    truncation_m: float = 0.08
    """the signed distance of a scene without fused depth saturates here"""
    scene_margin_m: float = 0.2
    """space kept around all that was measured"""
    agent_margin_m: float = 0.12
    """space kept around the agent template"""
    knot_frames: int = 10
    """frames between the knots of camera corrections"""
    doubt: Doubt = Doubt()
    """of the agent's roots"""


def build(
    videos: Sequence[Video],
    template: Template,
    shapes: Shapes,
    seed: int,
    device: str,
    fused: Fused | None = None,
    scratch: Path | None = None,
    floor_m: float = -math.inf,
) -> Problem:
    """Make the problem; videos with a scene come first, so that codes count them. The scene learns on what is fused.

    Nothing is below ``floor_m``, a height in the world.

    Measurements are kept in unnamed files in ``scratch`` (None: where temporary files stand).
    """
    videos = scene_first(videos)
    torch.manual_seed(seed)
    thumbnail = tuple(max(video.store.views.depth.shape[axis] for video in videos) for axis in (1, 2))
    store = join((usable(video) for video in videos), scratch, thumbnail)
    lengths = [len(video.timestamp_s) for video in videos]
    camera = np.concatenate([filled(video.timestamp_s, video.world_from_camera) for video in videos])
    roots, kept = zip(*(steadied(video, shapes.doubt) for video in videos), strict=True)
    agent = np.concatenate([filled(video.timestamp_s, root) for video, root in zip(videos, roots, strict=True)])
    rooted = torch.from_numpy(np.concatenate([np.isfinite(root).all((1, 2)) for root in roots]))
    trust = torch.from_numpy(np.where(np.concatenate(kept), 1.0, shapes.doubt.trust)).float() * shown(store.views, shapes.doubt)
    vertices = template.mesh.vertices
    low, high = (
        tuple(float(x) for x in corner) for corner in (vertices.min(0) - shapes.agent_margin_m, vertices.max(0) + shapes.agent_margin_m)
    )
    agent_shape = FieldShape(low, high, shapes.agent_voxel_m, shapes.grid_channels, shapes.width, encoding=shapes.encoding)
    rest = torch.from_numpy(template.agent_from_bone_rest).float()
    by_frame = RaysByFrame.of(store.agent.frame, len(camera))
    usable_frames = torch.nonzero(rooted & store.views.agent_seen & (by_frame.count > 0))[:, 0]
    has_scene = torch.tensor([video.has_scene for video in videos])[frame_table(lengths)]
    free, poses = [video.camera_free for video in videos], map(torch.from_numpy, (camera, agent))
    motion = MotionTable(*poses, rest, lengths, free, shapes.knot_frames)
    body = Body(rest, torch.from_numpy(template.bone_scale_m).float(), agent_shape)
    surface = Surface.of(template.mesh, template.feature, np.random.default_rng(seed))
    with torch.no_grad():
        skin = body.weights(surface.points)
        joints, limbs = Joints.of(surface.points, skin), Limbs.of(surface.points, skin, rest)
    problem = Problem(
        store=store,
        scene=scene_field(videos, shapes, fused),
        agent=Field(agent_shape, free_m=0.1),
        body=body,
        motion=motion,
        video=frame_table(lengths),
        has_scene=has_scene,
        surface=surface,
        joints=joints,
        limbs=limbs,
        agent_frames=usable_frames,
        agent_rays=by_frame,
        trust=trust,
        firm=firmness(motion, np.concatenate([video.confidence for video in videos])),
        floor_m=floor_m,
    )
    return problem if device == "cpu" else _moved(problem, device)


def scene_field(videos: Sequence[Video], shapes: Shapes, fused: Fused | None) -> Field:
    """Return the scene's field, empty where nothing is fused, in the box of what was measured."""
    shape = FieldShape(
        *measured_box(videos, shapes.scene_margin_m),
        shapes.scene_voxel_m,
        shapes.grid_channels,
        shapes.width,
        sum(video.has_scene for video in videos) if shapes.code_channels else 0,
        shapes.code_channels,
        truncation_m=fused.truncation_m if fused else shapes.truncation_m,
        encoding=shapes.encoding,
    )
    return Field(shape, free_m=-0.03, fused=fused)


def scene_first(videos: Sequence[Video]) -> list[Video]:
    """Return the videos in the order of frames and codes: those with a scene first."""
    return sorted(videos, key=lambda video: not video.has_scene)


def scene_ids(videos: Sequence[Video]) -> tuple[str, ...]:
    """Return the ids in the order of the scene's codes."""
    return tuple(video.id for video in scene_first(videos) if video.has_scene)


def usable(video: Video, least_confidence: float = 0.1) -> Store:
    """Drop the rays of frames whose camera is unknown or doubtful."""
    good = torch.from_numpy(np.isfinite(video.world_from_camera).all((1, 2)) & (video.confidence >= least_confidence))
    store = video.store
    return Store(*(rays.at(torch.nonzero(good[rays.frame])[:, 0]) for rays in (store.scene, store.agent)), store.views)


def steadied(video: Video, doubt: Doubt) -> tuple[Float[np.ndarray, "frame 4 4"], Bool[np.ndarray, "frame"]]:
    """Replace roots that registration doubts and that leap away from the certain ones around them.

    Returns:
        The roots (NaN where unknown), and which frames were left as they are.
    """
    root, when = video.world_from_agent.copy(), video.timestamp_s
    known = np.isfinite(root).all((1, 2))
    certain = known & (video.agent_confidence >= doubt.least_confidence) if video.agent_confidence is not None else known
    kept = np.ones(len(root), bool)
    if certain.sum() < 2:
        return root, kept
    certain_s = when[certain]
    doubted = np.flatnonzero(known & ~certain & (gaps_s(when, certain) <= doubt.longest_gap_s))
    between = rigid.interpolate(certain_s, root[certain], when[doubted])
    far = np.linalg.norm(root[doubted, :3, 3] - between[:, :3, 3], axis=1) > doubt.farthest_m
    root[doubted[far]], kept[doubted[far]] = between[far], False
    return root, kept


def shown(views: Views, doubt: Doubt) -> Float[Tensor, "frame"]:
    """Tell how much of the animal each frame shows, as a weight of its mask: by the mask's area at the animal's distance."""
    area = torch.zeros(len(views.depth))
    for frame in torch.nonzero(views.agent_seen)[:, 0].tolist():
        inside = views.outside_px[frame] < 0
        depth = views.depth[frame][inside].float()
        if (depth > 0).any():
            area[frame] = inside.sum() * (depth[depth > 0].median() / views.intrinsics[frame, 0, 0]) ** 2
    if not (area > 0).any():
        return torch.ones_like(area)
    share = area / area[area > 0].quantile(USUAL)
    return torch.where(area > 0, (share / doubt.whole_share).clamp(doubt.least_share, 1), 1.0)


def filled(timestamp_s: Float[np.ndarray, "frame"], a_from_b: Float[np.ndarray, "frame 4 4"]) -> Float[np.ndarray, "frame 4 4"]:
    """Interpolate unknown poses between known ones; all unknown gives identities."""
    known = np.isfinite(a_from_b).all((1, 2))
    if not known.any():
        return np.tile(np.eye(4), (len(a_from_b), 1, 1))
    return rigid.interpolate(timestamp_s[known], a_from_b[known], timestamp_s)


def measured_box(videos: Sequence[Video], margin_m: float, most: int = 200_000) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """Return the box of nearly all measured points of the scene (about ``most`` are asked), and of the cameras that saw them."""
    step = max(7, sum(len(video.store.scene) for video in videos) // most)
    stores = (usable(video).scene for video in videos)
    rays = [store.at(torch.nonzero(store.depth > 0)[:, 0][::step]) for store in stores]
    points = [
        rigid.apply(video.world_from_camera[some.frame.numpy()], (some.direction * some.depth[:, None]).numpy()[:, None])[:, 0]
        for video, some in zip(videos, rays, strict=True)
    ]
    eyes = [video.world_from_camera[np.unique(some.frame.numpy()), :3, 3] for video, some in zip(videos, rays, strict=True)]
    points, eyes = np.concatenate(points), np.concatenate(eyes)
    low = np.minimum(np.quantile(points, 0.002, axis=0), eyes.min(0)) - margin_m
    high = np.maximum(np.quantile(points, 0.998, axis=0), eyes.max(0)) + margin_m
    return tuple(float(x) for x in low), tuple(float(x) for x in high)


def _moved(problem: Problem, device: str) -> Problem:
    """Return the problem on another device."""
    for module in problem.modules().values():
        module.to(device)
    store = Store(problem.store.scene.to(device), problem.store.agent.to(device), problem.store.views.to(device))
    by_frame = RaysByFrame(problem.agent_rays.start.to(device), problem.agent_rays.count.to(device))
    moved = {
        name: getattr(problem, name).to(device)
        for name in ("video", "has_scene", "surface", "joints", "limbs", "agent_frames", "trust", "firm")
    }
    return Problem(store=store, **problem.modules(), agent_rays=by_frame, floor_m=problem.floor_m, **moved)
