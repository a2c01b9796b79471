"""Extract and write the results: motion, surfaces, skin, features, track points."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from scipy.spatial import KDTree
from torch import Tensor

from pipeline.data import motion, ply
from pipeline.data.motion import FEATURE_VOLUME, INTERPOLATED, TRACKS, Motion, gaps_s
from pipeline.data.templates import SkinTable
from pipeline.fields import fields, marching_cubes
from pipeline.fields.fields import Reconstruction
from pipeline.geometry import cameras, rigid, rigid_torch, subsampling
from pipeline.geometry.meshes import Mesh
from stages.reconstruct.assemble import RegisteredVideo, scene_first
from stages.reconstruct.body import NEAREST_M
from stages.reconstruct.problem import Problem
from stages.reconstruct.rays import THUMBNAIL

VOXEL_M = 0.1
"""edge of the voxels of the feature volume"""
FREE, SURFACE, UNSEEN = 0, 1, 2
"""values of its occupancy"""
AGENT_STEP_M = 0.01
"""resolution of the extracted agent: at 0.02 a tail disappears"""
SEEN_WITHIN_M = 0.03
"""the scene's surface is removed where no measured point is this near: backs, 4 cm behind, and rims"""
SMOOTHING_S = 0.7
"""window of the filter of motion, longer than a stride"""
TRACK_POINTS = 200
"""vertices of the agent that are followed, by farthest-point sampling"""
MAX_POINTS, MAX_FRAMES = 3_000_000, 300
"""approximate limits of measured points, and of frames tested for free space, after subsampling"""


@dataclass(frozen=True)
class SceneFeatures:
    """Occupancy and features of the room, for the behavior model."""

    features: Float[np.ndarray, "channel x y z"]
    """half precision; zero in free and unseen space"""
    occupancy: UInt8[np.ndarray, "x y z"]
    """0 free, 1 surface or inside, 2 unseen"""
    origin: Float[np.ndarray, "3"]
    """world position of the corner of voxel 0"""


@torch.no_grad()
def motions(
    problem: Problem, videos: Sequence[RegisteredVideo], certain_gap_s: float, smoothing_s: float = 0.0
) -> dict[str, Motion]:
    """Return each video's motion in world coordinates; the turnaround's world is the agent's rest frame.

    Poses of the agent are interpolated wherever no frame shows it. In gaps longer than ``certain_gap_s``
    seconds the confidence is `INTERPOLATED` at most. Root and bones of sessions are filtered over windows of
    ``smoothing_s`` seconds: optimization leaves noise that shakes a resting animal.
    """
    result, table = {}, problem.motion
    known = torch.zeros(len(problem.video), dtype=torch.bool)
    known[problem.agent_frames.cpu()] = True
    for index, video in enumerate(scene_first(videos)):
        frame = torch.nonzero(problem.video == index)[:, 0]
        root = table.world_from_agent(frame).double().cpu().numpy()
        bones = table.agent_from_bone(frame).double().cpu().numpy()
        observed = known[frame.cpu()].numpy()
        root, bones = interpolate_gaps(video.timestamp_s, root, bones, observed)
        if video.camera_free and smoothing_s and observed.sum() > 1:
            window = max(1, round(smoothing_s / np.median(np.diff(video.timestamp_s))))
            root, bones = (rigid.wiener_filter(poses, observed, window) for poses in (root, bones))
        camera = table.world_from_camera(frame).double().cpu().numpy()
        camera[~np.isfinite(video.world_from_camera).all((1, 2))] = np.nan
        visible, confidence = video.agent_visible & observed, video.confidence
        if visible.any():
            uncertain = gaps_s(video.timestamp_s, visible) > certain_gap_s
            confidence = np.where(uncertain, np.minimum(confidence, INTERPOLATED), confidence)
        result[video.id] = Motion(video.timestamp_s, camera, root, bones, confidence, visible)
    return result


def interpolate_gaps(
    timestamp_s: Float[np.ndarray, "frame"],
    root: Float[np.ndarray, "frame 4 4"],
    bones: Float[np.ndarray, "frame bone 4 4"],
    observed: Bool[np.ndarray, "frame"],
) -> tuple[Float[np.ndarray, "frame 4 4"], Float[np.ndarray, "frame bone 4 4"]]:
    """Interpolate poses between observed frames, constant beyond them; roots are NaN without any."""
    root, bones = root.copy(), bones.copy()
    if not observed.any():
        root[:] = np.nan
        return root, bones
    known = timestamp_s[observed], root[observed], bones[observed]
    root[~observed], bones[~observed] = rigid.interpolate_body(*known, timestamp_s[~observed])
    return root, bones


def scene_surface(problem: Problem, measured: KDTree) -> Mesh:
    """Return the shared scene's surface in the world, meters, where `measured_points` are near."""
    mesh = marching_cubes.extract_scene(problem.scene, -1, problem.scene.lattice_m)
    near, _ = measured.query(mesh.vertices, distance_upper_bound=SEEN_WITHIN_M)
    return marching_cubes.keep_vertices(mesh, np.isfinite(near))


@torch.no_grad()
def measured_points(problem: Problem) -> Float[np.ndarray, "point 3"]:
    """Return a subsample of the measured points of the scene, world, meters: of the thumbnails of frames,
    since the rays are too sparse on walls that are far away or were filmed briefly.
    """
    views, frame = problem.store.views, torch.unique(problem.store.scene.frame).long()
    frame = frame[:: max(1, len(frame) * views.depth[0].numel() // MAX_POINTS)]
    shown = torch.nonzero((views.depth[frame] > 0) & (views.outside_px[frame] > THUMBNAIL))
    pixel, frame = (shown[:, [2, 1]] + 0.5) * THUMBNAIL, frame[shown[:, 0]]
    depth = views.depth[frame, shown[:, 1], shown[:, 2]].float()[:, None]
    points = cameras.unproject(pixel, views.intrinsics[frame]) * depth
    return rigid_torch.apply(problem.motion.world_from_camera(frame), points[:, None])[:, 0].cpu().numpy()


@torch.no_grad()
def feature_volume(problem: Problem, measured: KDTree) -> SceneFeatures:
    """Sample the shared scene on a lattice of `VOXEL_M`: surface by its field, free space by depth."""
    field = problem.scene
    low = np.floor(np.array(field.shape.low_m) / VOXEL_M) * VOXEL_M
    size = np.ceil((np.array(field.shape.high_m) - low) / VOXEL_M).astype(int)
    index = np.stack(np.meshgrid(*(np.arange(n) for n in size), indexing="ij"), axis=-1).reshape(-1, 3)
    points = torch.from_numpy(low + (index + 0.5) * VOXEL_M).float().to(problem.device)
    encoded = field.encode(points, torch.full((len(points),), -1, device=points.device))
    distance = field.distance(encoded).cpu().numpy()
    feature = field.color_and_feature(encoded)[1].cpu().numpy()
    free = seen_free(problem, points).cpu().numpy()
    near, _ = measured.query(points.cpu().numpy(), distance_upper_bound=VOXEL_M)
    seen = np.isfinite(near)
    solid = (distance < 0.5 * VOXEL_M) & seen | (distance < 0) & ~free
    occupancy = np.where(solid, SURFACE, np.where(free, FREE, UNSEEN)).astype(np.uint8)
    features = np.where(seen & solid, feature.T, 0).astype(np.float16)
    return SceneFeatures(features.reshape(-1, *size), occupancy.reshape(size), low)


@torch.no_grad()
def seen_free(problem: Problem, points_world: Float[Tensor, "point 3"]) -> Bool[Tensor, "point"]:
    """Return which points some camera saw through: the depth at their pixel is clearly behind them."""
    views, frames = problem.store.views, torch.unique(problem.store.scene.frame).long()
    frames = frames[:: max(1, len(frames) // MAX_FRAMES)]
    camera_from_world = torch.linalg.inv(problem.motion.world_from_camera(frames).double()).float()
    seen_through = torch.zeros(len(points_world), dtype=torch.bool, device=points_world.device)
    height, width = views.depth.shape[1:]
    for frame, matrix in zip(frames, camera_from_world, strict=True):
        camera = points_world @ matrix[:3, :3].T + matrix[:3, 3]
        z, intrinsics = camera[:, 2].clamp_min(1e-3), views.intrinsics[frame]
        cell = ((camera[:, :2] / z[:, None]) @ intrinsics[:2, :2].T + intrinsics[:2, 2]) / THUMBNAIL
        inside = cameras.in_picture(cell, camera[:, 2], (height, width), NEAREST_M)
        column, row = cell.floor().long().unbind(-1)
        depth = views.depth[frame][row.clamp(0, height - 1), column.clamp(0, width - 1)].float()
        seen_through |= inside & (depth > camera[:, 2] + 0.5 * VOXEL_M)
    return seen_through


@torch.no_grad()
def skin_weights(problem: Problem, mesh: Mesh) -> Float[np.ndarray, "vertex bone"]:
    """Return the skinning weights of a rest surface's vertices."""
    return problem.body.weights(torch.from_numpy(mesh.vertices).to(problem.device)).cpu().numpy()


def write(
    folder: Path,
    problem: Problem,
    reconstruction: Reconstruction,
    motions: Mapping[str, Motion],
    sessions: Collection[str],
) -> None:
    """Write motion per video (the templates' apart), surfaces, skin, fields, feature volume, track points."""
    (folder / "templates").mkdir()
    for id, of_video in motions.items():
        path = folder / id / "motion.npz" if id in sessions else folder / "templates" / f"{id}.npz"
        path.parent.mkdir(exist_ok=True)
        motion.save(path, of_video)
    agent = marching_cubes.extract_agent(problem.agent, AGENT_STEP_M)
    measured = KDTree(measured_points(problem))
    ply.write_ply(folder / "scene.ply", scene_surface(problem, measured))
    ply.write_ply(folder / "agent.ply", agent)
    body, skin = reconstruction.body, skin_weights(problem, agent)
    rest, scale_m = (part.detach().cpu().numpy() for part in (body.agent_from_bone_rest, body.bone_scale_m))
    SkinTable(skin, rest, scale_m).write(folder)
    fields.save(folder, reconstruction)
    volume = feature_volume(problem, measured)
    FEATURE_VOLUME.save(
        folder / "feature_volume.npz", compress=True, voxel_m=np.asarray(VOXEL_M, np.float64), **vars(volume)
    )
    index = subsampling.farthest_points(agent.vertices, TRACK_POINTS, int(agent.vertices[:, 2].argmax()))
    TRACKS.save(folder / "tracks.npz", vertex_index=index, rest_agent=agent.vertices[index])
