"""Read the results off a solved problem: motion per video, surfaces, skin, feature volume, track points."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from scipy.spatial import cKDTree

from pipeline.models import surfaces
from pipeline.models.motion import Motion, gaps_s
from pipeline.space import rigid
from pipeline.space.meshes import Mesh
from stages.reconstruct.assemble import Video, scene_first
from stages.reconstruct.problem import Problem

VOXEL_M = 0.1
FREE, SURFACE, UNSEEN = 0, 1, 2


@dataclass(frozen=True)
class FeatureVolume:
    """What is where in the room, for the behaviour model."""

    features: Float[np.ndarray, "channel x y z"]
    """half precision; zero in free and unseen space"""
    occupancy: UInt8[np.ndarray, "x y z"]
    """0 free, 1 surface or inside, 2 unseen"""
    origin: Float[np.ndarray, "3"]
    """world position of the corner of voxel 0"""


@dataclass(frozen=True)
class Gaps:
    """How moments without a view of the agent are crossed."""

    longest_s: float = 2.0
    """its pose is interpolated over gaps up to this long; over longer ones it is inferred"""
    certain_s: float = 0.75
    """over gaps longer than this it has `INFERRED` confidence, either way"""


@torch.no_grad()
def motions(problem: Problem, videos: Sequence[Video], longest_gap_s: float) -> dict[str, Motion]:
    """Return each video's motion (the turnaround's world is the agent); poses of the agent are interpolated over gaps up to ``longest_gap_s``."""
    found, table = {}, problem.motion
    known = torch.zeros(len(problem.video), dtype=torch.bool)
    known[problem.agent_frames.cpu()] = True
    for index, video in enumerate(scene_first(videos)):
        frame = torch.nonzero(problem.video == index)[:, 0]
        root = table.world_from_agent(frame).double().cpu().numpy()
        bones = table.agent_from_bone(frame).double().cpu().numpy()
        good = known[frame.cpu()].numpy()
        root, bones = bridged(video.timestamp_s, root, bones, good, longest_gap_s)
        camera = table.world_from_camera(frame).double().cpu().numpy()
        camera[~np.isfinite(video.world_from_camera).all((1, 2))] = np.nan
        found[video.id] = Motion(video.timestamp_s, camera, root, bones, video.confidence, video.agent_visible & good)
    return found


def bridged(
    timestamp_s: Float[np.ndarray, "frame"],
    root: Float[np.ndarray, "frame 4 4"],
    bones: Float[np.ndarray, "frame bone 4 4"],
    good: np.ndarray,
    longest_gap_s: float,
) -> tuple[Float[np.ndarray, "frame 4 4"], Float[np.ndarray, "frame bone 4 4"]]:
    """Interpolate poses over short gaps between good frames; others become NaN (roots) and rest with their neighbours (bones)."""
    root, bones = root.copy(), bones.copy()
    if not good.any():
        root[:] = np.nan
        return root, bones
    when = timestamp_s[good]
    root[~good] = rigid.interpolate(when, root[good], timestamp_s[~good])
    for bone in range(bones.shape[1]):
        bones[~good, bone] = rigid.interpolate(when, bones[good, bone], timestamp_s[~good])
    root[gaps_s(timestamp_s, good) > longest_gap_s] = np.nan
    return root, bones


def scene_surface(problem: Problem, reach_m: float = 0.045) -> Mesh:
    """Return the shared scene's surface, cut where nothing was measured within ``reach_m``: backs of thin shells, rims."""
    mesh = surfaces.extract_scene(problem.scene, -1, problem.scene.lattice_m)
    near, _ = cKDTree(measured_points(problem)).query(mesh.vertices, distance_upper_bound=reach_m)
    return surfaces.keep_vertices(mesh, np.isfinite(near))


def agent_surface(problem: Problem, step_m: float) -> Mesh:
    """Return the agent's closed surface at rest."""
    return surfaces.extract_agent(problem.agent, step_m)


@torch.no_grad()
def measured_points(problem: Problem, most: int = 3_000_000) -> Float[np.ndarray, "point 3"]:
    """Return measured points of the scene in the world, thinned."""
    rays = problem.store.scene
    index = torch.nonzero(rays.depth > 0)[:, 0]
    rays = rays.at(index[:: max(1, len(index) // most)])
    pose = problem.motion.world_from_camera(rays.frame)
    points = (pose[:, :3, :3] @ (rays.direction * rays.depth[:, None])[..., None])[..., 0] + pose[:, :3, 3]
    return points.cpu().numpy()


@torch.no_grad()
def feature_volume(problem: Problem, most_frames: int = 300) -> FeatureVolume:
    """Ask the shared scene on a 0.1 m lattice: its surface from the field, free space from what cameras looked through."""
    field = problem.scene
    low = np.floor(np.array(field.shape.low_m) / VOXEL_M) * VOXEL_M
    size = np.ceil((np.array(field.shape.high_m) - low) / VOXEL_M).astype(int)
    index = np.stack(np.meshgrid(*(np.arange(n) for n in size), indexing="ij"), axis=-1).reshape(-1, 3)
    points = torch.from_numpy(low + (index + 0.5) * VOXEL_M).float().to(problem.device)
    encoded = field.encode(points, torch.full((len(points),), -1, device=points.device))
    distance, feature = field.distance(encoded).cpu().numpy(), field.look(encoded)[1].cpu().numpy()
    free = looked_through(problem, points, most_frames).cpu().numpy()
    measured = np.isfinite(cKDTree(measured_points(problem)).query(points.cpu().numpy(), distance_upper_bound=VOXEL_M)[0])
    solid = (distance < 0.5 * VOXEL_M) & measured | (distance < 0) & ~free
    occupancy = np.where(solid, SURFACE, np.where(free, FREE, UNSEEN)).astype(np.uint8)
    features = np.where(measured & solid, feature.T, 0).astype(np.float16)
    return FeatureVolume(features.reshape(-1, *size), occupancy.reshape(size), low)


@torch.no_grad()
def looked_through(problem: Problem, points_world: torch.Tensor, most_frames: int) -> torch.Tensor:
    """Tell which points some camera that is not in doubt saw through: they project onto a pixel whose depth lies clearly behind them."""
    views, frames = problem.store.views, torch.unique(problem.store.scene.frame).long()
    frames = frames[:: max(1, len(frames) // most_frames)]
    camera_from_world = torch.linalg.inv(problem.motion.world_from_camera(frames).double()).float()
    through = torch.zeros(len(points_world), dtype=torch.bool, device=points_world.device)
    height, width = views.depth.shape[1:]
    for frame, matrix in zip(frames, camera_from_world, strict=True):
        camera = points_world @ matrix[:3, :3].T + matrix[:3, 3]
        z = camera[:, 2].clamp_min(1e-3)
        pixel = (camera[:, :2] / z[:, None]) @ views.intrinsics[frame, :2, :2].T + views.intrinsics[frame, :2, 2]
        cell = (pixel / 4).floor().long()
        inside = (camera[:, 2] > 0.1) & (cell >= 0).all(-1) & (cell[:, 0] < width) & (cell[:, 1] < height)
        depth = views.depth[frame][cell[:, 1].clamp(0, height - 1), cell[:, 0].clamp(0, width - 1)].float()
        through |= inside & (depth > camera[:, 2] + 0.5 * VOXEL_M)
    return through


@torch.no_grad()
def skin_weights(problem: Problem, mesh: Mesh) -> Float[np.ndarray, "vertex bone"]:
    """Return the skinning weights of a rest surface's vertices."""
    return problem.body.weights(torch.from_numpy(mesh.vertices).to(problem.device)).cpu().numpy()


def track_points(mesh: Mesh, number: int = 200) -> tuple[Int[np.ndarray, "point"], Float[np.ndarray, "point 3"]]:
    """Choose well-spread vertices of the agent by farthest-point sampling: their indices and rest positions."""
    chosen = [int(np.argmax(mesh.vertices[:, 2]))]
    distance = np.linalg.norm(mesh.vertices - mesh.vertices[chosen[0]], axis=-1)
    for _ in range(min(number, len(mesh.vertices)) - 1):
        chosen.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(mesh.vertices - mesh.vertices[chosen[-1]], axis=-1))
    return np.array(chosen), mesh.vertices[chosen]
