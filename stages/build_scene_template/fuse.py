"""Fuse the walk-through's depth and colour into a surface, align every frame to it, clean it, and give it
features."""

import subprocess
import sys
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from pipeline.core.errors import InputError
from pipeline.core.progress import track
from pipeline.data import ply as mesh_files
from pipeline.data.clips import Clip
from pipeline.geometry import cameras, rigid, subsampling, tsdf
from pipeline.geometry.meshes import Mesh
from pipeline.mapping import depth_scans, pose_optimization
from stages.build_scene_template.config import FusionConfig
from stages.build_scene_template.refine import DEPTH_INFLATION, odometry_factors

MOST_VOXELS = 150_000_000
"""More would take over 4 GB."""


CONFIDENCE_WEIGHT = (0.2, 0.6, 1.0)
"""Weight of depth of low, medium and high confidence; rims and thin legs are seen with low confidence
only."""
LEAST_WEIGHT = 0.15
"""A voxel needs this weight, in views from one metre, to carry surface."""
EXTENT_STRIDE_PX, EXTENT_STEP, EXTENT_TRIM = 12, 4, 0.001
"""Pixels and keyframes that measure the room's extent, and the share of points cut at each end."""
ALIGN_REACH_M = (0.1, 0.04)
"""Width of the robust weight in the first and last round of the alignment to the surface, metres."""
ALIGN_POINTS, ALIGN_LEAST_POINTS = 400_000, 40
"""Depth points that take part, so that memory stays bounded, and least number per frame."""
NEAREST_M, SEEN_WITHIN_M = 0.2, 0.06
"""A vertex is seen by a frame when it lies beyond the first and measured depth agrees within the second,
metres."""


def fuse(
    clip: Clip,
    frames: Int[np.ndarray, "view"],
    world_from_camera: Float[np.ndarray, "frame 4 4"],
    config: FusionConfig,
) -> Mesh:
    """Integrate the frames into one volume and extract what was seen. Raises InputError MAP-005 where that is
    too large."""
    scans = [
        depth_scans.scan(
            clip.depth(int(f)),
            clip.depth_intrinsics[f],
            stride=EXTENT_STRIDE_PX,
            furthest_m=config.furthest_m,
        )
        for f in frames[::EXTENT_STEP]
    ]
    points = np.concatenate(
        [
            rigid.apply(world_from_camera[f], scan.points_camera)
            for f, scan in zip(frames[::EXTENT_STEP], scans, strict=True)
        ]
    )
    extent_m = np.ptp(np.quantile(points, [EXTENT_TRIM, 1 - EXTENT_TRIM], axis=0), axis=0)
    if np.prod(extent_m / config.voxel_m) > MOST_VOXELS:
        spans = " x ".join(f"{side:.0f}" for side in extent_m)
        what = f"the walk-through spans {spans} m: too much for voxels of {config.voxel_m:g} m"
        raise InputError(
            "MAP-005",
            what,
            str(clip.folder),
            "walk through one room, or set a larger voxel_m in [build_scene_template.fusion]",
        )
    volume = tsdf.enclose(points, voxel_m=config.voxel_m, truncation_m=config.truncation_m)
    for frame in track(frames.tolist(), "fusing frames"):
        depth = clip.depth(frame)
        depth = np.where(depth < config.furthest_m, depth, 0)
        weight = np.array(CONFIDENCE_WEIGHT, np.float32)[clip.confidence(frame)]
        volume.integrate(
            depth,
            clip.depth_intrinsics[frame],
            clip.color(frame),
            clip.intrinsics[frame],
            world_from_camera[frame],
            weight,
        )
    return volume.surface(LEAST_WEIGHT)


def align_frames(
    clip: Clip, mesh: Mesh, world_from_camera: Float[np.ndarray, "frame 4 4"], config: FusionConfig
) -> tuple[Float[np.ndarray, "frame 4 4"], Float[np.ndarray, "frame"]]:
    """Optimize every frame against the surface and the odometry; also return each frame's median gap,
    metres."""
    surface, frames = depth_scans.SurfaceMap(mesh), np.arange(len(clip))
    most = max(ALIGN_POINTS // len(clip), ALIGN_LEAST_POINTS)
    scans = [
        depth_scans.scan(
            clip.depth(f),
            clip.depth_intrinsics[f],
            stride=config.align_stride_px,
            confidence=clip.confidence(f),
            furthest_m=config.furthest_m,
        ).subsampled(most)
        for f in range(len(clip))
    ]

    def find(poses, reach_m):
        return surface.correspondences(frames, scans, poses, reach_m, DEPTH_INFLATION)

    reach = tuple(np.geomspace(*ALIGN_REACH_M, config.align_rounds))
    optimized = pose_optimization.optimize_poses(
        world_from_camera, find, odometry_factors(clip, frames), reach_m=reach
    )
    gap = np.full(len(clip), np.nan)
    for frame in range(len(clip)):
        own = np.abs(optimized.residual_m[optimized.correspondences.first == frame])
        gap[frame] = np.median(own) if len(own) else np.nan
    return optimized.world_from_camera, gap


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
    """Average the features of the frames that see each vertex (depth agrees), weighted by 1 / depth,
    L2-normalised; zero where none does.
    """
    total = np.zeros((len(mesh.vertices), features.shape[-1]))
    for frame in subsampling.evenly(len(clip), frames):
        local = rigid.apply(rigid.inverse(world_from_camera[frame]), mesh.vertices.astype(float))
        pixel, z = cameras.project(local, clip.intrinsics[frame])
        height, width = clip.color_size
        inside = np.flatnonzero(
            (z > NEAREST_M) & (pixel > 0).all(1) & (pixel[:, 0] < width) & (pixel[:, 1] < height)
        )
        depth = clip.depth(int(frame))
        scale = np.array(depth.shape[::-1]) / (width, height)
        column, row = np.minimum((pixel[inside] * scale).astype(int), np.array(depth.shape[::-1]) - 1).T
        inside = inside[np.abs(depth[row, column] - z[inside]) < SEEN_WITHIN_M]
        cell = np.minimum(
            pixel[inside] * np.array(features.shape[2:0:-1]) / (width, height),
            np.array(features.shape[2:0:-1]) - 1,
        ).astype(int)
        total[inside] += np.asarray(features[frame][cell[:, 1], cell[:, 0]], float) / z[inside, None]
    return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-9)
