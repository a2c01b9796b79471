"""Cameras of a plain video in the map: landmarks, tracking between frames, and joint optimization.

Pictures with enough landmarks are localized by them. The others are tracked from their neighbors by optical
flow on the map's surface. Then all frames are optimized jointly, by flow to warped pictures of the
walk-through and flow between neighbors.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float, UInt8

from pipeline.core.progress import log, track
from pipeline.geometry import cameras, rigid, subsampling
from pipeline.geometry.meshes import RayCaster
from pipeline.mapping import sift
from pipeline.mapping.pose_optimization import MAP, Correspondences, optimize_poses
from pipeline.mapping.sift import Keypoints
from stages.estimate_depth import landmarks, views
from stages.estimate_depth import lens as lenses
from stages.estimate_depth.landmarks import Matches
from stages.estimate_depth.lens import Lens, PnPResult, locate
from stages.estimate_depth.views import View

WALK_VIEWS = 2
"""Pictures of the walk-through that each frame is compared with: those with most overlap."""
NEIGHBORS = (1, 3)
"""Frame gaps of the flow between neighbors. Tracked over a longer one, a camera locks on to another board."""
PROBES = 60
"""Sample pixels that measure the overlap with pictures of the walk-through."""
MIN_RATIO, GOOD_RATIO = 0.35, 0.7
"""Inlier ratio of flow that a tracked pose needs, and with which no further hypothesis is tried."""
MIN_RELIABLE = 3
"""Frames localized by landmarks that a segment between jumps needs."""
MAX_M_S, MAX_RAD_S = 3.0, 4.0
"""Faster camera motion between frames is a jump."""
SIGMA_PX, INLIER_PX = 8.0, 2.5
"""Standard deviation of flow, whose errors are correlated over hundreds of pixels, and RANSAC threshold, in
pixels of the small pictures."""
MAX_PASSES, CONVERGED, REACH_M = 8, 0.005, (0.1, 0.05, 0.05)
"""Most passes of matching, change of the focal length that ends them, robust scales within each, meters."""


@dataclass(frozen=True)
class Tracked:
    """Cameras in the map's world."""

    world_from_camera: Float[np.ndarray, "frame 4 4"]
    """NaN for frames without a pose."""
    by_landmarks: Bool[np.ndarray, "frame"]
    """Localized by landmarks; the others are tracked from their neighbors."""
    lens: Lens
    """Of the small pictures, refined with the cameras."""

    @property
    def placed(self) -> Bool[np.ndarray, "frame"]:
        """Return which frames have a pose."""
        return np.isfinite(self.world_from_camera[:, 0, 0])


@dataclass(frozen=True)
class TrackingInput:
    """A video's input to tracking."""

    timestamp_s: Float[np.ndarray, "frame"]
    gray: Sequence[UInt8[np.ndarray, "height width"]]
    """Small undistorted pictures (`views.small_gray`)."""
    keypoints: Sequence[Keypoints]
    """In pixels of the small pictures."""
    lens: Lens
    """Of the small pictures, without distortion."""


@dataclass(frozen=True)
class MapViews:
    """The map: its surface, and views of the walk-through."""

    caster: RayCaster
    walk: Sequence[View]


def place(
    footage: TrackingInput, localized: Float[np.ndarray, "frame 4 4"], room: MapViews, seed: int
) -> Tracked:
    """Estimate all cameras; ``localized`` are those by landmarks, NaN where unknown."""
    poses = localized.copy()
    discard_stray_segments(footage.timestamp_s, poses, np.isfinite(poses[:, 0, 0]))
    sure = np.isfinite(poses[:, 0, 0])
    if sure.any():  # the others by their distance from a localized one
        distance = np.abs(np.arange(len(sure))[:, None] - np.flatnonzero(sure)).min(1)
        for frame in track(np.argsort(distance, kind="stable")[sure.sum() :].tolist(), "tracking"):
            _track_one(frame, footage, poses, room, seed)
    discard_stray_segments(footage.timestamp_s, poses, sure)
    placed = np.flatnonzero(np.isfinite(poses[:, 0, 0]))
    log(f"{int(sure.sum())} frames placed by landmarks, {len(placed)} of {len(poses)} in all")
    lens = footage.lens
    for number in range(MAX_PASSES if len(placed) else 0):
        footage = replace(footage, lens=lens)
        poses[placed], lens = _optimize(placed, footage, poses[placed], room, seed)
        if number and abs(lens.focal_px / footage.lens.focal_px - 1) < CONVERGED:
            break
    return Tracked(poses, sure, footage.lens)


def discard_stray_segments(
    timestamp_s: Float[np.ndarray, "frame"],
    poses: Float[np.ndarray, "frame 4 4"],
    sure: Bool[np.ndarray, "frame"],
) -> None:
    """Discard, in place, segments between jumps with fewer than `MIN_RELIABLE` frames localized by landmarks.

    On repetitive floors, flow locks on to the wrong board.
    """
    known = np.flatnonzero(np.isfinite(poses[:, 0, 0]))
    if len(known) < 2:
        return
    gap_s = np.maximum(np.diff(timestamp_s[known]), 1e-3)
    fast = np.linalg.norm(np.diff(poses[known, :3, 3], axis=0), axis=1) > MAX_M_S * gap_s
    fast |= rigid.rotation_angle(poses[known[:-1], :3, :3], poses[known[1:], :3, :3]) > MAX_RAD_S * gap_s
    segment = np.r_[0, np.cumsum(fast)]
    reliable_count = np.bincount(segment, sure[known], minlength=segment[-1] + 1)
    poses[known[(reliable_count < min(MIN_RELIABLE, reliable_count.max()))[segment]]] = np.nan


def _view(frame: int, footage: TrackingInput, pose, room: MapViews) -> View:
    return views.view_of(footage.gray[frame], footage.lens.intrinsics, pose, room.caster)


def _track_one(frame, footage: TrackingInput, poses, room: MapViews, seed) -> None:
    """Track one frame, in place, from its nearest neighbor, by the hypothesis with most inliers."""
    known = np.flatnonzero(np.isfinite(poses[:, 0, 0]))
    other = int(known[np.abs(known - frame).argmin()])
    if abs(other - frame) > NEIGHBORS[-1]:
        return
    source, best = _view(other, footage, poses[other], room), None
    for hypothesis in _hypotheses(frame, other, footage, poses, room, seed):
        matches = views.flow_matches(_view(frame, footage, hypothesis, room), source)
        found = locate(matches, footage.lens, seed, within_px=INLIER_PX)
        if found is not None and (best is None or found.inlier_ratio > best.inlier_ratio):
            best = found
        if best is not None and best.inlier_ratio >= GOOD_RATIO:
            break
    if best is not None and best.inlier_ratio >= MIN_RATIO:
        poses[frame] = best.world_from_camera


def _hypotheses(frame, other, footage: TrackingInput, poses, room: MapViews, seed) -> Iterator[np.ndarray]:
    """Yield pose hypotheses: constant velocity, matched keypoints, and the neighbor's pose."""
    beyond = 2 * other - frame
    if 0 <= beyond < len(poses) and np.isfinite(poses[beyond, 0, 0]):
        yield poses[other] @ rigid.inverse(poses[beyond]) @ poses[other]
    own, theirs = footage.keypoints[frame], footage.keypoints[other]
    mine, yours = sift.matches(own.descriptors, theirs.descriptors).T
    points = landmarks.on_surface(theirs.pixel[yours], footage.lens.intrinsics, poses[other], room.caster)
    hit = np.isfinite(points[:, 0])
    found = locate(Matches(own.pixel[mine[hit]], points[hit]), footage.lens, seed)
    if found is not None:
        yield found.world_from_camera
    yield poses[other]


def walk_views(target: View, room: MapViews) -> list[int]:
    """Return which pictures of the walk-through overlap most with a view, at a similar scale."""
    rows, columns = np.nonzero(target.depth > 0)
    chosen = np.linspace(0, len(rows) - 1, PROBES).astype(int) if len(rows) else np.zeros(0, int)
    z = target.depth[rows[chosen], columns[chosen]]
    pixel = cameras.pixel_centers(rows, columns)[chosen]
    points = rigid.apply(target.world_from_camera, cameras.unproject(pixel, target.intrinsics) * z[:, None])
    scores = np.zeros(len(room.walk))
    for number, each in enumerate(room.walk):
        points_camera = rigid.apply(rigid.inverse(each.world_from_camera), points)
        there, theirs = cameras.project(points_camera, each.intrinsics)
        inside = cameras.in_picture(there, theirs, each.gray.shape, 0.1)
        seen = each.depth[cameras.pixel_index(there[inside])]
        same = np.abs(seen - theirs[inside]) < views.OCCLUDED_M + views.OCCLUDED_SHARE * theirs[inside]
        scale = theirs[inside] / each.intrinsics[0, 0] / (z[inside] / target.intrinsics[0, 0])
        scores[number] = (same * np.minimum(scale, 1 / np.maximum(scale, 1e-6))).sum()
    best = np.argsort(-scores, kind="stable")[:WALK_VIEWS]
    return [number for number in best.tolist() if scores[number] > 0]


@dataclass(frozen=True)
class _FlowFactor:
    """Rays of one camera and the corresponding points of the map or of another camera."""

    first: int
    second: int
    """`MAP`, or a camera."""
    pixel: Float[np.ndarray, "match 2"]
    points: Float[np.ndarray, "match 3"]
    """In the world, or in the second camera, meters."""


def _optimize(
    frames, footage: TrackingInput, poses, room: MapViews, seed
) -> tuple[Float[np.ndarray, "placed 4 4"], Lens]:
    """Jointly optimize the poses by flow matched from the current ones; then refine the lens."""
    seen = [_view(int(frame), footage, pose, room) for frame, pose in zip(frames, poses, strict=True)]
    at, sigma = {int(frame): number for number, frame in enumerate(frames)}, SIGMA_PX / footage.lens.focal_px
    factors: list[_FlowFactor] = []
    for number, frame in enumerate(track(frames.tolist(), "matching by flow")):
        for shown in walk_views(seen[number], room):
            matches = _inliers(views.flow_matches(seen[number], room.walk[shown]), footage.lens, seed)
            factors.append(_FlowFactor(number, MAP, matches.pixel, matches.points_world))
        for other in (at[frame + gap] for gap in NEIGHBORS if frame + gap in at):
            matches = _inliers(views.flow_matches(seen[other], seen[number]), footage.lens, seed)
            points_camera = rigid.apply(rigid.inverse(poses[number]), matches.points_world)
            factors.append(_FlowFactor(other, number, matches.pixel, points_camera))

    def find(current, reach_m):
        return Correspondences.join(*(_to_rays(factor, current, sigma, footage.lens) for factor in factors))

    poses = optimize_poses(poses, find, None, reach_m=REACH_M).world_from_camera
    mapped = [factor for factor in factors if factor.second == MAP and len(factor.pixel)]
    placed = []
    for factor in (mapped[number] for number in subsampling.evenly(len(mapped), lenses.FRAMES)):
        matches = Matches(factor.pixel, factor.points)
        placed.append(PnPResult(poses[factor.first], matches, 1.0, footage.lens.focal_px))
    return poses, lenses.bundle_adjust(footage.lens, placed, distortion=False) if placed else footage.lens


def _inliers(matches: Matches, lens: Lens, seed) -> Matches:
    """Keep the inliers of one camera."""
    found = locate(matches, lens, seed, within_px=INLIER_PX)
    return Matches(np.zeros((0, 2)), np.zeros((0, 3))) if found is None else found.matches


def _to_rays(factor: _FlowFactor, current, sigma, lens: Lens) -> Correspondences:
    """Return point-to-ray correspondences across the rays at the current cameras."""
    first, second, pixel, points = factor.first, factor.second, factor.pixel, factor.points
    world = points if second == MAP else rigid.apply(current[second], points)
    z = np.maximum(rigid.apply(rigid.inverse(current[first]), world)[:, 2], 0.1)
    rays, count = cameras.unproject(pixel, lens.intrinsics), len(pixel)
    ends, parts = (np.full(count, first), np.full(count, second)), []
    for axis in (0, 1):
        side = np.zeros((count, 3))
        side[:, axis], side[:, 2] = 1, -rays[:, axis]
        direction = side @ current[first][:3, :3].T
        parts.append(Correspondences(*ends, rays * z[:, None], points, direction, sigma * z))
    return Correspondences.join(*parts)
