"""Refine the walk-through's keyframes against each other by what they share.

Matched points (`pipeline.mapping.bundle_adjustment`), overlapping depth (along surface normals) and odometry
between neighbours count by measured variances: points by their reprojection errors, depth and odometry by how
far they contradict cameras from points.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from pipeline.data.clips import Clip, usable_depth
from pipeline.geometry import cameras, rigid
from pipeline.mapping import depth_scans, pose_optimization
from pipeline.mapping.bundle_adjustment import PointTerm, TrackedPoints
from stages.build_scene_template.config import RefinementConfig

DRIFT_RAD_S, DRIFT_M_S = np.deg2rad(0.5), 0.02
"""Drift of the odometry that the graph allows, several times that of phones: depth decides."""
DEPTH_INFLATION = 4.0
"""Depth noise is multiplied by this, since neighbouring pixels err together."""
STRIDE_PX = 10
"""One depth pixel in so many, each way, is used."""
REACH_M = (0.15, 0.04)
"""Width of the robust weight in the first and last round, metres."""
CANDIDATE_REACH = 1.5
"""Point pairs up to so many reaches apart are candidates."""
NEAREST_M = 0.1
"""Depth below this is none, metres."""
MIN_COSINE = 0.7
"""Normals of a pair, both known, agree within 45 degrees: rims and backs of thin walls are other surfaces."""
FIRST_ROUNDS, FIRST_INFLATION = 6, 3.0
"""Steps that place keyframes by points and odometry, and factor on the deviation of depth in them."""
SHARED_POINTS, MIN_PAIRS = 30, 10
"""Depth of pairs that share so many points is judged by them; fewer pairs judge nothing."""
MIN_VARIANCE = 0.25
"""Least factor on the assumed variance of depth: neighbouring pixels err together more than pairs show."""
OVERLAP_STEP, MIN_OVERLAP = 7, 0.3
"""One point in so many measures the overlap of two keyframes; the least share that makes them neighbours."""


@dataclass(frozen=True)
class Keyframe:
    """One keyframe: subsampled points, and the full depth to compare with (metres, camera axes)."""

    scan: depth_scans.Scan
    depth: Float[np.ndarray, "height width"]
    normals: Float[np.ndarray, "height width 3"]
    intrinsics: Float[np.ndarray, "3 3"]


def load_keyframe(clip: Clip, frame: int) -> Keyframe:
    """Read one frame's depth, its subsampled points and its normals (camera axes, zero where unknown)."""
    depth, intrinsics = usable_depth(clip, frame), clip.depth_intrinsics[frame]
    scan = depth_scans.scan(depth, intrinsics, stride=STRIDE_PX)
    return Keyframe(scan, depth, depth_scans.image_normals(depth, intrinsics), intrinsics)


def depth_correspondences(
    keyframes: list[Keyframe],
    pairs: Int[np.ndarray, "pair 2"],
    world_from_camera: Float[np.ndarray, "key 4 4"],
    reach_m: float,
) -> pose_optimization.Correspondences:
    """Project each pair's points into the other's depth image and pair them with the plane seen there."""
    parts = [_pair_correspondences(keyframes, int(a), int(b), world_from_camera, reach_m) for a, b in pairs]
    return pose_optimization.Correspondences.join(*parts)


def _pair_correspondences(keyframes, first, second, world_from_camera, reach_m):
    source, target = keyframes[first].scan, keyframes[second]
    second_from_first = rigid.inverse(world_from_camera[second]) @ world_from_camera[first]
    moved = rigid.apply(second_from_first, source.points_camera)
    pixel, z = cameras.project(moved, target.intrinsics)
    inside = np.flatnonzero(cameras.in_picture(pixel, z, target.depth.shape, NEAREST_M))
    column, row = np.floor(pixel[inside]).astype(int).T
    met = cameras.unproject(pixel[inside], target.intrinsics) * target.depth[row, column, None]
    normal = target.normals[row, column]
    gap = np.abs(np.einsum("ci,ci->c", moved[inside] - met, normal))
    own = keyframes[first].normals.reshape(-1, 3)[source.pixel_index[inside]] @ second_from_first[:3, :3].T
    good = (np.einsum("ci,ci->c", own, normal) > MIN_COSINE) & (gap < CANDIDATE_REACH * reach_m)
    inside, met = inside[good], met[good]
    sigma = DEPTH_INFLATION * np.hypot(source.sigma_m[inside], depth_scans.depth_noise(met[:, 2]))
    direction = normal[good] @ world_from_camera[second, :3, :3].T
    a, b = (np.full(len(inside), key) for key in (first, second))
    return pose_optimization.Correspondences(a, b, source.points_camera[inside], met, direction, sigma)


def overlapping(
    world_from_camera: Float[np.ndarray, "key 4 4"], keyframes: list[Keyframe], neighbours: int
) -> Int[np.ndarray, "pair 2"]:
    """Pick for each keyframe its successor and the others that see most of its points."""
    pairs = []
    for first, keyframe in enumerate(keyframes):
        points = keyframe.scan.points_camera[::OVERLAP_STEP]
        seen = np.zeros(len(keyframes))
        for second in range(len(keyframes)):
            local = rigid.apply(rigid.inverse(world_from_camera[second]) @ world_from_camera[first], points)
            pixel, z = cameras.project(local, keyframe.intrinsics)
            inside = cameras.in_picture(pixel, z, keyframe.depth.shape, NEAREST_M)
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
    """Optimize the keyframes against each other by points, depth and odometry; the first one is fixed."""
    fixed, odometry = np.arange(len(frames)) == 0, odometry_factors(clip, frames)
    poses, term, inflation = world_from_camera, None, 1.0
    pairs = overlapping(poses, keyframes, config.neighbours)

    def find(poses, reach_m):
        return depth_correspondences(keyframes, pairs, poses, reach_m).inflated(inflation)

    if len(tracked.camera):
        term, inflation, reach = PointTerm(tracked, poses), FIRST_INFLATION, (REACH_M[0],) * FIRST_ROUNDS
        first = pose_optimization.optimize_poses(
            poses, find, odometry, reach_m=reach, fixed=fixed, term=term
        )  # fmt: skip
        poses = first.world_from_camera
        pairs = overlapping(poses, keyframes, config.neighbours)
        inflation = np.sqrt(depth_variance(keyframes, pairs, poses, tracked))
        if odometry is not None:
            variance = pose_optimization.variance_factor(odometry.chi_squares(poses))
            odometry = odometry.inflated(np.sqrt(max(1.0, variance)))
    reach = tuple(np.geomspace(*REACH_M, config.rounds))
    found = pose_optimization.optimize_poses(poses, find, odometry, reach_m=reach, fixed=fixed, term=term)
    return found.world_from_camera


def depth_variance(
    keyframes: list[Keyframe],
    pairs: Int[np.ndarray, "pair 2"],
    world_from_camera: Float[np.ndarray, "key 4 4"],
    tracked: TrackedPoints,
) -> float:
    """Return the variance of overlapping depth over the assumed one, judged by cameras that share points.

    It is 1 where too few pairs do.
    """
    shared = tracked.shared(len(keyframes))
    judged = [(int(a), int(b)) for a, b in pairs if shared[a, b] >= SHARED_POINTS]
    parts = [_pair_correspondences(keyframes, a, b, world_from_camera, REACH_M[0]) for a, b in judged]
    parts = [part for part in parts if len(part.first) >= SHARED_POINTS]
    if len(parts) < MIN_PAIRS:
        return 1.0
    group = np.repeat(np.arange(len(parts)), [len(part.first) for part in parts])
    joined = pose_optimization.Correspondences.join(*parts)
    squares = pose_optimization.chi_squares(world_from_camera, joined, group, REACH_M[0])
    return max(MIN_VARIANCE, pose_optimization.variance_factor(squares))


def odometry_factors(
    clip: Clip, frames: Int[np.ndarray, "key"], otherwise: Float[np.ndarray, "key 4 4"] | None = None
) -> pose_optimization.RelativePoseFactors | None:
    """Return the odometry between neighbouring frames of a selection; without it, that of ``otherwise``."""
    odometry = otherwise if clip.odometry_from_camera is None else clip.odometry_from_camera[frames]
    if odometry is None:
        return None
    drift = dict(drift_rad_s=DRIFT_RAD_S, drift_m_s=DRIFT_M_S)
    return pose_optimization.odometry_factors(clip.timestamp_s[frames], odometry, **drift)
