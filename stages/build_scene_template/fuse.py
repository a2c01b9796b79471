"""Fuse the walk-through's depth and colour into a surface, align every frame to it, clean it, and give it features."""

import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from pipeline.errors import InputError
from pipeline.files import meshes as mesh_files
from pipeline.files.clips import Clip
from pipeline.progress import track
from pipeline.space import cameras, relax, rigid, surface, tsdf
from pipeline.space.meshes import Mesh
from stages.build_scene_template.refine import RefineOptions, odometry_edges

MOST_VOXELS = 150_000_000
"""More would take over 4 GB."""


@dataclass(frozen=True)
class FuseOptions:
    """Resolution and reach of the fusion."""

    voxel_m: float = 0.025
    """Edge of a voxel, metres."""
    truncation_m: float = 0.1
    """Distances are clipped here, metres; about three times the depth noise at the far end."""
    furthest_m: float = 4.5
    """Depth beyond this is not fused, metres."""
    trust: tuple[float, float, float] = (0.2, 0.6, 1.0)
    """Weight of depth of low, medium and high confidence; rims and thin legs are seen with low confidence only."""
    least_views: float = 0.15
    """A voxel needs this much weight, in views from one metre, to carry surface."""
    island_faces: int = 120
    """Smaller separate pieces of surface are dropped, faces."""
    align_rounds: int = 4
    """Gauss-Newton steps that align every frame to the surface."""
    align_stride_px: int = 9
    """One depth pixel in so many, each way, takes part in the alignment."""
    align_points: int = 400_000
    """Depth points that take part; scans of larger or more pictures are thinned evenly, so that memory stays bounded ..."""
    align_least_points: int = 40
    """... but a scan keeps so many."""
    feature_frames: int = 80
    """Frames that lend their features to the vertices, spread evenly."""


def fuse(clip: Clip, frames: Int[np.ndarray, "view"], world_from_camera: Float[np.ndarray, "frame 4 4"], options: FuseOptions) -> Mesh:
    """Integrate the frames into one volume and extract what was seen. Raises InputError MAP-005 where that is too large."""
    scans = [surface.scan(clip.depth(int(f)), clip.depth_intrinsics[f], stride=12, furthest_m=options.furthest_m) for f in frames[::4]]
    points = np.concatenate([rigid.apply(world_from_camera[f], scan.points_camera) for f, scan in zip(frames[::4], scans, strict=True)])
    extent_m = np.ptp(np.quantile(points, [0.001, 0.999], axis=0), axis=0)
    if np.prod(extent_m / options.voxel_m) > MOST_VOXELS:
        what = f"the walk-through spans {' x '.join(f'{side:.0f}' for side in extent_m)} m: too much for voxels of {options.voxel_m:g} m"
        raise InputError(
            "MAP-005", what, str(clip.folder), "walk through one room, or set a larger voxel_m in [build_scene_template.fusion]"
        )
    volume = tsdf.enclose(points, voxel_m=options.voxel_m, truncation_m=options.truncation_m)
    for frame in track(frames.tolist(), "fusing frames"):
        depth = clip.depth(frame)
        depth = np.where(depth < options.furthest_m, depth, 0)
        trust = np.array(options.trust, np.float32)[clip.confidence(frame)]
        volume.integrate(
            depth,
            clip.depth_intrinsics[frame],
            clip.color(frame),
            clip.intrinsics[frame],
            world_from_camera[frame],
            trust,
        )
    return volume.surface(options.least_views)


def align_frames(
    clip: Clip,
    mesh: Mesh,
    world_from_camera: Float[np.ndarray, "frame 4 4"],
    options: FuseOptions,
    weights: RefineOptions,
) -> tuple[Float[np.ndarray, "frame 4 4"], Float[np.ndarray, "frame"]]:
    """Relax every frame against the surface and the odometry; also return each frame's median gap in metres."""
    place, frames = surface.Surface(mesh), np.arange(len(clip))
    most = max(options.align_points // len(clip), options.align_least_points)
    scans = [
        surface.scan(
            clip.depth(f),
            clip.depth_intrinsics[f],
            stride=options.align_stride_px,
            confidence=clip.confidence(f),
            furthest_m=options.furthest_m,
        ).thinned(most)
        for f in frames
    ]

    def find(poses, reach_m):
        found = place.contacts(frames, scans, poses, reach_m)
        sigma = np.full(len(found.first), weights.depth_inflation) * found.sigma_m
        return relax.Contacts(found.first, found.second, found.points_first, found.points_second, found.direction_world, sigma)

    reach = tuple(np.geomspace(0.1, 0.04, options.align_rounds))
    relaxed = relax.relax(world_from_camera, find, odometry_edges(clip, frames, weights), reach_m=reach)
    gap = np.full(len(clip), np.nan)
    for frame in range(len(clip)):
        mine = np.abs(relaxed.residual_m[relaxed.contacts.first == frame])
        gap[frame] = np.median(mine) if len(mine) else np.nan
    return relaxed.world_from_camera, gap


def clean(mesh: Mesh, workspace: Path, island_faces: int) -> Mesh:
    """Clean a mesh in MeshLab's own process. Raises InputError MAP-003 when that program fails."""
    source, target = workspace / "raw.ply", workspace / "clean.ply"
    mesh_files.write_ply(source, mesh)
    program = Path(__file__).with_name("clean_mesh.py")
    environment = {"OMP_NUM_THREADS": "1", "OMP_WAIT_POLICY": "PASSIVE", "PATH": "/usr/bin:/bin"}
    done = subprocess.run(
        [sys.executable, str(program), str(source), str(target), str(island_faces)],
        env=environment,
        capture_output=True,
        text=True,
    )
    if done.returncode or not target.exists():
        last = (done.stderr.strip().splitlines() or ["no message"])[-1]
        raise InputError(
            "MAP-003",
            what=f"pymeshlab failed: {last}",
            where=program.name,
            remedy="install its libraries: apt-get install libgl1 libopengl0",
        )
    return mesh_files.read_ply(target)


def vertex_features(
    clip: Clip,
    features: Float[np.ndarray, "frame height width channel"],
    mesh: Mesh,
    world_from_camera: Float[np.ndarray, "frame 4 4"],
    frames: int,
) -> Float[np.ndarray, "vertex channel"]:
    """Average the features of the frames that see each vertex (depth within 6 cm), L2-normalised; zero where none
    does.
    """
    total = np.zeros((len(mesh.vertices), features.shape[-1]))
    for frame in np.unique(np.linspace(0, len(clip) - 1, frames).astype(int)):
        local = rigid.apply(rigid.inverse(world_from_camera[frame]), mesh.vertices.astype(float))
        pixel, z = cameras.project(local, clip.intrinsics[frame])
        height, width = clip.color_size
        inside = np.flatnonzero((z > 0.2) & (pixel > 0).all(1) & (pixel[:, 0] < width) & (pixel[:, 1] < height))
        depth = clip.depth(int(frame))
        scale = np.array(depth.shape[::-1]) / (width, height)
        column, row = np.minimum((pixel[inside] * scale).astype(int), np.array(depth.shape[::-1]) - 1).T
        inside = inside[np.abs(depth[row, column] - z[inside]) < 0.06]
        cell = np.minimum(pixel[inside] * np.array(features.shape[2:0:-1]) / (width, height), np.array(features.shape[2:0:-1]) - 1).astype(
            int
        )
        total[inside] += np.asarray(features[frame][cell[:, 1], cell[:, 0]], float) / z[inside, None]
    return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-9)
