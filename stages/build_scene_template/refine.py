"""Refine the walk-through's keyframes against each other.

They are tied by what they share: SfM tracks (sideways, by pixel noise) and overlapping depth (along surface
normals), with odometry between neighbours: correspondences of `pipeline.mapping.pose_optimization`.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from pipeline.data.clips import Clip, usable_depth
from pipeline.geometry import cameras, rigid
from pipeline.mapping import depth_scans, pose_optimization
from pipeline.mapping.colmap import SparseModel
from stages.build_scene_template.config import RefinementConfig
from stages.build_scene_template.sfm import points_under

DRIFT_RAD_S, DRIFT_M_S = np.deg2rad(0.5), 0.02
"""Drift of the odometry that the graph allows, several times that of phones: depth decides."""
PIXEL_SIGMA_PX = 1.5
"""Standard deviation of a SIFT feature's position, colour pixels."""
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
TRACK_HOPS = (1, 3)
"""Observations of a track are paired with the next one and the third after it."""
OVERLAP_STEP, LEAST_OVERLAP = 7, 0.3
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
    good = (np.abs(normal).sum(1) > 0) & (gap < CANDIDATE_REACH * reach_m)
    inside, met = inside[good], met[good]
    sigma = DEPTH_INFLATION * np.hypot(source.sigma_m[inside], depth_scans.depth_noise(met[:, 2]))
    direction = normal[good] @ world_from_camera[second, :3, :3].T
    a, b = (np.full(len(inside), key) for key in (first, second))
    return pose_optimization.Correspondences(a, b, source.points_camera[inside], met, direction, sigma)


@dataclass(frozen=True)
class TrackMatches:
    """Depth points under the same SfM track in two keyframes, camera axes, and their sideways noise."""

    first: Int[np.ndarray, "tie"]
    second: Int[np.ndarray, "tie"]
    points_first: Float[np.ndarray, "tie 3"]
    points_second: Float[np.ndarray, "tie 3"]
    sigma_m: Float[np.ndarray, "tie"]

    def correspondences(
        self, world_from_camera: Float[np.ndarray, "key 4 4"]
    ) -> pose_optimization.Correspondences:
        """Constrain the points across the second camera's ray; along it depth is more accurate."""
        ray = self.points_second / np.linalg.norm(self.points_second, axis=1, keepdims=True)
        sides = []
        for axis in (np.array([0.0, 1.0, 0.0]), np.array([1.0, 0.0, 0.0])):
            side = axis - (ray @ axis)[:, None] * ray
            side /= np.linalg.norm(side, axis=1, keepdims=True)
            direction = np.einsum("cij,cj->ci", world_from_camera[self.second, :3, :3], side)
            sides.append(
                pose_optimization.Correspondences(
                    self.first, self.second, self.points_first, self.points_second, direction, self.sigma_m
                )
            )
        return pose_optimization.Correspondences.join(*sides)


def match_tracks(sparse: SparseModel, clip: Clip, key_of_view: Int[np.ndarray, "view"]) -> TrackMatches:
    """Pair each observation of a track that has depth with the track's next one and the third after it."""
    points = np.full((len(sparse.observed_key), 3), np.nan)
    for view, frame in enumerate(sparse.frame):
        row = np.flatnonzero(sparse.observed_key == view)
        points[row] = points_under(clip, int(frame), sparse.observed_pixel[row])
    order = np.lexsort((sparse.observed_key, sparse.observed_point))
    order = order[np.isfinite(points[order, 0])]
    track = sparse.observed_point[order]
    hops = [np.stack([order[:-hop], order[hop:]], 1)[track[:-hop] == track[hop:]] for hop in TRACK_HOPS]
    first, second = np.concatenate(hops).T
    focal = clip.intrinsics[sparse.frame[sparse.observed_key[second]], 0, 0]
    sigma = PIXEL_SIGMA_PX * points[second, 2] / focal
    first_key, second_key = (key_of_view[sparse.observed_key[each]] for each in (first, second))
    return TrackMatches(first_key, second_key, points[first], points[second], sigma)


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
        best = ranked[seen[ranked] > LEAST_OVERLAP]
        chosen = {first + 1, *best[:: max(1, len(best) // neighbours)][:neighbours].tolist()}
        pairs += [(first, second) for second in sorted(chosen) if second < len(keyframes)]
    return np.array(pairs).reshape(-1, 2)


def refine_keyframes(
    clip: Clip,
    frames: Int[np.ndarray, "key"],
    keyframes: list[Keyframe],
    world_from_camera: Float[np.ndarray, "key 4 4"],
    sparse: SparseModel | None,
    config: RefinementConfig,
) -> Float[np.ndarray, "key 4 4"]:
    """Optimize the keyframes against each other by depth, SfM tracks and odometry; the first one is fixed."""
    pairs = overlapping(world_from_camera, keyframes, config.neighbours)
    tracks = None if sparse is None else match_tracks(sparse, clip, np.searchsorted(frames, sparse.frame))

    def find(poses, reach_m):
        correspondences = depth_correspondences(keyframes, pairs, poses, reach_m)
        if tracks is None:
            return correspondences
        return pose_optimization.Correspondences.join(correspondences, tracks.correspondences(poses))

    fixed, odometry = np.arange(len(frames)) == 0, odometry_factors(clip, frames)
    reach = tuple(np.geomspace(*REACH_M, config.rounds))
    found = pose_optimization.optimize_poses(world_from_camera, find, odometry, reach_m=reach, fixed=fixed)
    return found.world_from_camera


def odometry_factors(
    clip: Clip, frames: Int[np.ndarray, "key"]
) -> pose_optimization.RelativePoseFactors | None:
    """Return the odometry between neighbouring frames of a selection, None where there is none."""
    odometry, time_s = clip.odometry_from_camera, clip.timestamp_s[frames]
    if odometry is None:
        return None
    drift = dict(drift_rad_s=DRIFT_RAD_S, drift_m_s=DRIFT_M_S)
    return pose_optimization.odometry_factors(time_s, odometry[frames], **drift)
