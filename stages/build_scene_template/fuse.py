"""Fuse the walk-through's depth and color to a surface, align every frame to it, clean it, add features."""

import subprocess
import sys
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Int

from pipeline.core.errors import InputError
from pipeline.core.progress import track
from pipeline.data import ply as mesh_files
from pipeline.data.clips import Clip
from pipeline.geometry import cameras, rigid, tsdf
from pipeline.geometry.meshes import Mesh
from pipeline.mapping import depth_scans, pose_optimization
from pipeline.mapping.pose_optimization import optimize_poses
from stages.build_scene_template.config import FusionConfig
from stages.build_scene_template.refine import DEPTH_INFLATION, odometry_factors

MAX_VOXELS = 150_000_000
"""Limits memory to 4 GB."""
CONFIDENCE_WEIGHT = (0.2, 0.6, 1.0)
"""Fusion weight of low, medium and high confidence; depth edges and thin legs have only low confidence."""
MIN_WEIGHT = 0.15
"""Least weight of a surface voxel, in units of one view from one meter."""
EXTENT_STRIDE_PX, EXTENT_STEP, EXTENT_TRIM = 12, 4, 0.001
"""Pixel and keyframe strides for measuring the room's extent, and the quantile trimmed at each end."""
ALIGN_REACH_M = (0.1, 0.04)
"""Width of the robust weight in the first and last round of the alignment to the surface, meters."""
ALIGN_POINTS, ALIGN_MIN_POINTS = 400_000, 40
"""Total of depth points, which bounds memory, and least number per frame."""
MIN_FIT = 0.85
"""A registered frame's share of depth that fits the surface, relative to the median frame's. Correctly placed
frames have 0.92 and more in a real kitchen, 0.97 in the built-in home; displaced by 1.3 m and 50 degrees, at
most 0.25 and 0.8."""
MIN_DEPTH_M, SEEN_WITHIN_M = 0.2, 0.06
"""A frame sees a vertex beyond the first distance if measured depth agrees within the second, meters."""


def fuse(
    clip: Clip,
    frames: Int[np.ndarray, "view"],
    world_from_camera: Float[np.ndarray, "frame 4 4"],
    config: FusionConfig,
) -> Mesh:
    """Fuse the frames into a TSDF and extract the mesh. Raises InputError MAP-005 if too large."""
    points = []
    for frame in frames[::EXTENT_STEP].tolist():
        depth, intrinsics = clip.depth(frame), clip.depth_intrinsics[frame]
        scan = depth_scans.scan(depth, intrinsics, stride=EXTENT_STRIDE_PX, max_depth_m=config.furthest_m)
        points.append(rigid.apply(world_from_camera[frame], scan.points_camera))
    points = np.concatenate(points)
    extent_m = np.ptp(np.quantile(points, [EXTENT_TRIM, 1 - EXTENT_TRIM], axis=0), axis=0)
    if np.prod(extent_m / config.voxel_m) > MAX_VOXELS:
        spans = " x ".join(f"{side:.0f}" for side in extent_m)
        what = f"the walk-through spans {spans} m: too much for voxels of {config.voxel_m:g} m"
        remedy = "walk through one room, or set a larger voxel_m in [build_scene_template.fusion]"
        raise InputError("MAP-005", what, str(clip.folder), remedy)
    volume = tsdf.enclose(points, voxel_m=config.voxel_m, truncation_m=config.truncation_m)
    for frame in track(frames.tolist(), "fusing frames"):
        depth, color = clip.depth(frame), clip.color(frame)
        depth = np.where(depth < config.furthest_m, depth, 0)
        weight = np.array(CONFIDENCE_WEIGHT, np.float32)[clip.confidence(frame)]
        depth_camera, color_camera = clip.depth_intrinsics[frame], clip.intrinsics[frame]
        volume.integrate(depth, depth_camera, color, color_camera, world_from_camera[frame], weight)
    return volume.surface(MIN_WEIGHT)


def align_frames(
    clip: Clip,
    mesh: Mesh,
    world_from_camera: Float[np.ndarray, "frame 4 4"],
    config: FusionConfig,
    keyframes: Int[np.ndarray, "key"] | None = None,
) -> tuple[Float[np.ndarray, "frame 4 4"], Float[np.ndarray, "frame"], Float[np.ndarray, "frame"]]:
    """Align every frame to the surface, with odometry; also return its `depth_scans.measure_fit`.

    Depth noise is rescaled by its chi-square at the keyframes; they stay fixed if it is too large.
    """
    surface, frames = depth_scans.SurfaceMap(mesh), np.arange(len(clip))
    max_points = max(ALIGN_POINTS // len(clip), ALIGN_MIN_POINTS)
    scans = [
        depth_scans.scan(
            clip.depth(f),
            clip.depth_intrinsics[f],
            stride=config.align_stride_px,
            confidence=clip.confidence(f),
            max_depth_m=config.furthest_m,
        ).subsampled(max_points)
        for f in range(len(clip))
    ]

    def associate(poses, reach_m):
        return surface.correspondences(frames, scans, poses, reach_m, inflation)

    inflation, fixed = DEPTH_INFLATION, np.zeros(len(clip), bool)
    if keyframes is not None:
        found = associate(world_from_camera, ALIGN_REACH_M[0])
        squares = pose_optimization.chi_squares(world_from_camera, found, found.first, ALIGN_REACH_M[0])
        variance = pose_optimization.variance_factor(squares[np.isin(np.arange(len(squares)), keyframes)])
        inflation *= np.sqrt(max(1.0, variance))
        fixed[keyframes] = variance > 1
    reach = tuple(np.geomspace(*ALIGN_REACH_M, config.align_rounds))
    motion = odometry_factors(clip, frames, fallback=world_from_camera)
    optimized = optimize_poses(world_from_camera, associate, motion, reach_m=reach, fixed=fixed)
    poses = optimized.world_from_camera
    return poses, *depth_scans.measure_fit(surface, scans, poses)


def registered(fit: Float[np.ndarray, "frame"]) -> Bool[np.ndarray, "frame"]:
    """Return which frames fit the surface nearly as well as the median frame, by shares of `align_frames`."""
    return (fit > 0) & (fit >= MIN_FIT * np.nanmedian(fit))


def clean(mesh: Mesh, workspace: Path, island_faces: int) -> Mesh | None:
    """Clean a mesh with MeshLab in a separate process; None if nothing is left. Raises InputError MAP-003."""
    source, target = workspace / "raw.ply", workspace / "clean.ply"
    mesh_files.write_ply(source, mesh)
    program = Path(__file__).with_name("clean_mesh.py")
    environment = {"OMP_NUM_THREADS": "1", "OMP_WAIT_POLICY": "PASSIVE", "PATH": "/usr/bin:/bin"}
    command = [sys.executable, program, source, target, str(island_faces)]
    completed = subprocess.run(command, env=environment, capture_output=True, text=True)
    if completed.returncode:
        last = (completed.stderr.strip().splitlines() or ["no message"])[-1]
        remedy = "install its libraries: apt-get install libgl1 libopengl0"
        raise InputError("MAP-003", f"pymeshlab failed: {last}", program.name, remedy)
    return mesh_files.read_ply(target) if target.exists() else None


def vertex_features(
    clip: Clip,
    features: Float[np.ndarray, "frame height width channel"],
    mesh: Mesh,
    world_from_camera: Float[np.ndarray, "frame 4 4"],
    frames: Int[np.ndarray, "some"],
) -> Float[np.ndarray, "vertex channel"]:
    """Average the features of frames that see each vertex, weighted by 1 / depth; unit norm or zero."""
    total = np.zeros((len(mesh.vertices), features.shape[-1]))
    for frame in frames:
        local = rigid.apply(rigid.inverse(world_from_camera[frame]), mesh.vertices.astype(float))
        pixel, z = cameras.project(local, clip.intrinsics[frame])
        depth, size = clip.depth(int(frame)), clip.color_size
        measured = cameras.sample_nearest(depth, pixel * np.divide(depth.shape, size)[::-1])
        inside = cameras.in_picture(pixel, z, size, MIN_DEPTH_M) & (np.abs(measured - z) < SEEN_WITHIN_M)
        inside, cells = np.flatnonzero(inside), np.array(features.shape[2:0:-1])
        column, row = np.minimum(pixel[inside] * cells / size[::-1], cells - 1).astype(int).T
        total[inside] += np.asarray(features[frame][row, column], float) / z[inside, None]
    return total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-9)
