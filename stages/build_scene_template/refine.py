"""Refine the walk-through's keyframe poses jointly.

Tracked points (`pipeline.mapping.bundle_adjustment`), overlapping depth (point to plane) and odometry are
weighted by estimated variances: points by reprojection errors, depth and odometry by their residuals under
cameras from points.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from pipeline.data.clips import Clip, usable_depth
from pipeline.geometry import cameras, rigid
from pipeline.mapping import depth_scans, pose_optimization
from pipeline.mapping.bundle_adjustment import PointTerm, TrackedPoints
from pipeline.mapping.pose_optimization import optimize_poses
from stages.build_scene_template.config import RefinementConfig

DRIFT_RAD_S, DRIFT_M_S = np.deg2rad(0.5), 0.02
"""Odometry drift assumed by the pose graph, several times that of phones, so that depth dominates."""
DEPTH_INFLATION = 4.0
"""Factor on depth noise, since errors of neighboring pixels are correlated."""
STRIDE_PX = 10
"""Grid spacing of the depth pixels."""
REACH_M = (0.15, 0.04)
"""Width of the robust kernel in the first and last round, meters."""
CANDIDATE_RATIO = 1.5
"""Largest point-to-plane distance of a correspondence, in reaches."""
MIN_DEPTH_M = 0.1
"""Smaller depth counts as missing, meters."""
MIN_COSINE = 0.7
"""Least cosine between the normals of a correspondence; rejects edges and backs of thin walls."""
FIRST_ROUNDS, FIRST_INFLATION = 6, 3.0
"""Initial steps that rely on points and odometry, and factor on the depth noise in them."""
SHARED_POINTS, MIN_PAIRS = 30, 10
"""Minimum tracked points of a pair that estimates depth variance, and minimum number of such pairs."""
MIN_VARIANCE = 0.25
"""Least factor on the assumed depth variance, since correlated errors are underestimated."""
OVERLAP_STEP, MIN_OVERLAP = 7, 0.3
"""Stride of the points that measure the overlap of two keyframes, and least overlap of a pair."""


@dataclass(frozen=True)
class Keyframe:
    """Subsampled points, full depth and normals of one keyframe (meters, camera frame)."""

    scan: depth_scans.Scan
    depth: Float[np.ndarray, "height width"]
    normals: Float[np.ndarray, "height width 3"]
    intrinsics: Float[np.ndarray, "3 3"]


def load_keyframe(clip: Clip, frame: int) -> Keyframe:
    """Load one frame's depth, subsampled points and normals."""
    depth, intrinsics = usable_depth(clip, frame), clip.depth_intrinsics[frame]
    scan = depth_scans.scan(depth, intrinsics, stride=STRIDE_PX)
    return Keyframe(scan, depth, depth_scans.image_normals(depth, intrinsics), intrinsics)


def depth_correspondences(
    keyframes: list[Keyframe],
    pairs: Int[np.ndarray, "pair 2"],
    world_from_camera: Float[np.ndarray, "key 4 4"],
    reach_m: float,
) -> pose_optimization.Correspondences:
    """Return projective point-to-plane correspondences of keyframe pairs."""
    parts = [_pair_correspondences(keyframes, int(a), int(b), world_from_camera, reach_m) for a, b in pairs]
    return pose_optimization.Correspondences.join(*parts)


def _pair_correspondences(keyframes, first, second, world_from_camera, reach_m):
    source, target = keyframes[first].scan, keyframes[second]
    second_from_first = rigid.inverse(world_from_camera[second]) @ world_from_camera[first]
    moved = rigid.apply(second_from_first, source.points_camera)
    pixel, z = cameras.project(moved, target.intrinsics)
    inside = np.flatnonzero(cameras.in_picture(pixel, z, target.depth.shape, MIN_DEPTH_M))
    at = cameras.pixel_index(pixel[inside])
    hit = cameras.unproject(pixel[inside], target.intrinsics) * target.depth[at][:, None]
    normal = target.normals[at]
    gap = np.abs(np.einsum("ci,ci->c", moved[inside] - hit, normal))
    own = keyframes[first].normals.reshape(-1, 3)[source.pixel_index[inside]] @ second_from_first[:3, :3].T
    good = (np.einsum("ci,ci->c", own, normal) > MIN_COSINE) & (gap < CANDIDATE_RATIO * reach_m)
    inside, hit = inside[good], hit[good]
    sigma = DEPTH_INFLATION * np.hypot(source.sigma_m[inside], depth_scans.depth_noise(hit[:, 2]))
    direction = normal[good] @ world_from_camera[second, :3, :3].T
    a, b = (np.full(len(inside), key) for key in (first, second))
    return pose_optimization.Correspondences(a, b, source.points_camera[inside], hit, direction, sigma)


def overlapping_pairs(
    world_from_camera: Float[np.ndarray, "key 4 4"], keyframes: list[Keyframe], neighbours: int
) -> Int[np.ndarray, "pair 2"]:
    """Pair each keyframe with its successor and with overlapping keyframes."""
    pairs = []
    for first, keyframe in enumerate(keyframes):
        points = keyframe.scan.points_camera[::OVERLAP_STEP]
        seen = np.zeros(len(keyframes))
        for second in range(len(keyframes)):
            local = rigid.apply(rigid.inverse(world_from_camera[second]) @ world_from_camera[first], points)
            pixel, z = cameras.project(local, keyframe.intrinsics)
            inside = cameras.in_picture(pixel, z, keyframe.depth.shape, MIN_DEPTH_M)
            seen[second] = inside.mean() if len(points) else 0
        seen[first] = 0
        ranked = np.argsort(-seen, kind="stable")
        best = ranked[seen[ranked] > MIN_OVERLAP]
        chosen = {first + 1, *best[:: max(1, len(best) // neighbours)][:neighbours].tolist()}
        pairs += [(first, second) for second in sorted(chosen) if second < len(keyframes)]
    return np.array(pairs).reshape(-1, 2)


def refine_keyframes(
    clip: Clip,
    frames: Int[np.ndarray, "key"],
    keyframes: list[Keyframe],
    world_from_camera: Float[np.ndarray, "key 4 4"],
    tracked: TrackedPoints,
    config: RefinementConfig,
) -> Float[np.ndarray, "key 4 4"]:
    """Optimize keyframe poses by points, depth and odometry; the first one is fixed."""
    fixed, odometry = np.arange(len(frames)) == 0, odometry_factors(clip, frames)
    poses, term, inflation = world_from_camera, None, 1.0
    pairs = overlapping_pairs(poses, keyframes, config.neighbours)

    def associate(poses, reach_m):
        return depth_correspondences(keyframes, pairs, poses, reach_m).inflated(inflation)

    if len(tracked.camera):
        term, inflation, reach = PointTerm(tracked, poses), FIRST_INFLATION, (REACH_M[0],) * FIRST_ROUNDS
        first = optimize_poses(poses, associate, odometry, reach_m=reach, fixed=fixed, term=term)
        poses = first.world_from_camera
        pairs = overlapping_pairs(poses, keyframes, config.neighbours)
        inflation = np.sqrt(depth_variance(keyframes, pairs, poses, tracked))
        if odometry is not None:
            variance = pose_optimization.variance_factor(odometry.chi_squares(poses))
            odometry = odometry.inflated(np.sqrt(max(1.0, variance)))
    reach = tuple(np.geomspace(*REACH_M, config.rounds))
    found = optimize_poses(poses, associate, odometry, reach_m=reach, fixed=fixed, term=term)
    return found.world_from_camera


def depth_variance(
    keyframes: list[Keyframe],
    pairs: Int[np.ndarray, "pair 2"],
    world_from_camera: Float[np.ndarray, "key 4 4"],
    tracked: TrackedPoints,
) -> float:
    """Return the ratio of actual to assumed depth variance, from covisible pairs; 1 if they are too few."""
    covisibility = tracked.covisibility(len(keyframes))
    covisible = [(int(a), int(b)) for a, b in pairs if covisibility[a, b] >= SHARED_POINTS]
    parts = [_pair_correspondences(keyframes, a, b, world_from_camera, REACH_M[0]) for a, b in covisible]
    parts = [part for part in parts if len(part.first) >= SHARED_POINTS]
    if len(parts) < MIN_PAIRS:
        return 1.0
    group = np.repeat(np.arange(len(parts)), [len(part.first) for part in parts])
    joined = pose_optimization.Correspondences.join(*parts)
    squares = pose_optimization.chi_squares(world_from_camera, joined, group, REACH_M[0])
    return max(MIN_VARIANCE, pose_optimization.variance_factor(squares))


def odometry_factors(
    clip: Clip, frames: Int[np.ndarray, "key"], fallback: Float[np.ndarray, "key 4 4"] | None = None
) -> pose_optimization.RelativePoseFactors | None:
    """Return odometry factors between consecutive frames of a selection; ``fallback`` replaces odometry."""
    odometry = fallback if clip.odometry_from_camera is None else clip.odometry_from_camera[frames]
    if odometry is None:
        return None
    drift = dict(drift_rad_s=DRIFT_RAD_S, drift_m_s=DRIFT_M_S)
    return pose_optimization.odometry_factors(clip.timestamp_s[frames], odometry, **drift)
