"""Cameras of a plain video in the map: landmarks, tracking between frames, and one adjustment of all.

A picture that shows much of the walk-through is placed by its landmarks. The others are tracked from their
neighbours by optical flow over the map's surface. Then all frames are optimized together: by flow from the
walk-through's pictures, seen from each camera, and by flow between neighbours.
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
from stages.estimate_depth.lens import Lens, Located, locate
from stages.estimate_depth.views import View

WALK_VIEWS = 2
"""Pictures of the walk-through that each frame is compared with: those that see the most of the same."""
NEIGHBOURS = (1, 3)
"""Frames after a frame that it is compared with."""
PROBES = 60
"""Pixels of a frame by which pictures of the walk-through that see the same are found."""
TRACKED_SHARE, ENOUGH_SHARE = 0.35, 0.7
"""Share of the flow between frames that must agree on a camera for it to be placed, and with which no other
explanation is searched."""
MIN_SURE = 3
"""Frames placed by landmarks that a piece between two jumps needs."""
FASTEST_M_S, FASTEST_RAD_S = 3.0, 4.0
"""A camera that moves faster than this between frames was misplaced."""
SIGMA_PX, GATE_PX = 8.0, 2.5
"""Deviation of flow, which errs together over hundreds of pixels, and how far a match may lie from the
camera's first answer, pixels of the small pictures."""
PASSES, REACH_M = 2, (0.1, 0.05, 0.05)
"""How often pictures are compared anew, and widths of the robust weight in each pass, metres."""


@dataclass(frozen=True)
class Tracked:
    """Cameras in the map's world."""

    world_from_camera: Float[np.ndarray, "frame 4 4"]
    """NaN where a frame was not placed."""
    by_landmarks: Bool[np.ndarray, "frame"]
    """Placed by the map alone; the others beside their neighbours."""
    lens: Lens
    """Of the small pictures, adjusted with the cameras."""

    @property
    def placed(self) -> Bool[np.ndarray, "frame"]:
        """Return which frames have a place."""
        return np.isfinite(self.world_from_camera[:, 0, 0])


@dataclass(frozen=True)
class TrackingInput:
    """What tracking reads of a video."""

    timestamp_s: Float[np.ndarray, "frame"]
    gray: Sequence[UInt8[np.ndarray, "height width"]]
    """Small straightened pictures (`views.small_gray`)."""
    keypoints: Sequence[Keypoints]
    """In pixels of the small pictures."""
    lens: Lens
    """Of the small pictures, without distortion."""


@dataclass(frozen=True)
class MapViews:
    """The map as pictures see it."""

    caster: RayCaster
    walk: Sequence[View]


def place(footage: TrackingInput, located: Sequence[Located | None], room: MapViews, seed: int) -> Tracked:
    """Place all frames that can be; ``located`` are those that landmarks place."""
    poses = np.full((len(located), 4, 4), np.nan)
    for frame, each in enumerate(located):
        if each is not None and each.sure:
            poses[frame] = each.world_from_camera
    forget_strays(footage.timestamp_s, poses, np.isfinite(poses[:, 0, 0]))
    sure = np.isfinite(poses[:, 0, 0])
    for frame in track(_outward(sure), "tracking"):
        _track_one(frame, footage, poses, room, seed)
    forget_strays(footage.timestamp_s, poses, sure)
    placed = np.flatnonzero(np.isfinite(poses[:, 0, 0]))
    log(f"{int(sure.sum())} frames placed by landmarks, {len(placed)} of {len(poses)} in all")
    for number in range(PASSES if len(placed) else 0):
        poses[placed], lens = _adjusted(placed, footage, poses[placed], room, seed)
        if number == 0:
            footage = replace(footage, lens=lens)
    return Tracked(poses, sure, footage.lens)


def _outward(sure: Bool[np.ndarray, "frame"]) -> list[int]:
    """Order the other frames by their distance from a sure one."""
    if not sure.any():
        return []
    distance = np.abs(np.arange(len(sure))[:, None] - np.flatnonzero(sure)).min(1)
    return [int(frame) for frame in np.argsort(distance, kind="stable") if distance[frame] > 0]


def forget_strays(
    timestamp_s: Float[np.ndarray, "frame"],
    poses: Float[np.ndarray, "frame 4 4"],
    sure: Bool[np.ndarray, "frame"],
) -> None:
    """Forget, in place, pieces between jumps that fewer than `MIN_SURE` frames placed by landmarks hold.

    On floors that repeat, flow locks on to the wrong board.
    """
    known = np.flatnonzero(np.isfinite(poses[:, 0, 0]))
    if len(known) < 2:
        return
    gap_s = np.maximum(np.diff(timestamp_s[known]), 1e-3)
    fast = np.linalg.norm(np.diff(poses[known, :3, 3], axis=0), axis=1) > FASTEST_M_S * gap_s
    fast |= rigid.rotation_angle(poses[known[:-1], :3, :3], poses[known[1:], :3, :3]) > FASTEST_RAD_S * gap_s
    piece = np.r_[0, np.cumsum(fast)]
    held = np.bincount(piece, sure[known], minlength=piece[-1] + 1)
    poses[known[(held < min(MIN_SURE, held.max()))[piece]]] = np.nan


def _view(frame: int, footage: TrackingInput, pose, room: MapViews) -> View:
    return views.view_of(footage.gray[frame], footage.lens.intrinsics, pose, room.caster)


def _track_one(frame, footage: TrackingInput, poses, room: MapViews, seed) -> None:
    """Place one frame beside its nearest placed neighbour, in place, from the guess that explains most."""
    known = np.flatnonzero(np.isfinite(poses[:, 0, 0]))
    other = int(known[np.abs(known - frame).argmin()])
    source, best = _view(other, footage, poses[other], room), None
    for guess in _guesses(frame, other, footage, poses, room, seed):
        matches = views.flow_matches(_view(frame, footage, guess, room), source)
        found = locate(matches, footage.lens, seed, within_px=GATE_PX)
        if found is not None and (best is None or found.share > best.share):
            best = found
        if best is not None and best.share >= ENOUGH_SHARE:
            break
    if best is not None and best.share >= TRACKED_SHARE:
        poses[frame] = best.world_from_camera


def _guesses(frame, other, footage: TrackingInput, poses, room: MapViews, seed) -> Iterator[np.ndarray]:
    """Yield where a frame may be: moved on as before, by matched keypoints, and where its neighbour is."""
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


def walk_views(target: View, room: MapViews) -> list[View]:
    """Return the pictures of the walk-through that see the most of what a view shows, at a like distance."""
    rows, columns = np.nonzero(target.depth > 0)
    chosen = np.linspace(0, len(rows) - 1, PROBES).astype(int) if len(rows) else np.zeros(0, int)
    z = target.depth[rows[chosen], columns[chosen]]
    pixel = np.stack([columns, rows], axis=1)[chosen] + 0.5
    points = rigid.apply(target.world_from_camera, cameras.unproject(pixel, target.intrinsics) * z[:, None])
    scores = np.zeros(len(room.walk))
    for number, each in enumerate(room.walk):
        points_camera = rigid.apply(rigid.inverse(each.world_from_camera), points)
        there, theirs = cameras.project(points_camera, each.intrinsics)
        at = np.floor(there).astype(int)
        inside = (theirs > 0.1) & ((at >= 0) & (at < each.gray.shape[::-1])).all(1)
        seen = each.depth[at[inside, 1], at[inside, 0]]
        same = np.abs(seen - theirs[inside]) < views.OCCLUDED_M + views.OCCLUDED_SHARE * theirs[inside]
        scale = theirs[inside] / each.intrinsics[0, 0] / (z[inside] / target.intrinsics[0, 0])
        scores[number] = (same * np.minimum(scale, 1 / np.maximum(scale, 1e-6))).sum()
    best = np.argsort(-scores, kind="stable")[:WALK_VIEWS]
    return [room.walk[number] for number in best if scores[number] > 0]


@dataclass(frozen=True)
class _Tie:
    """Rays of one camera, and the points of the map, or of another camera, that they meet."""

    first: int
    second: int
    """`MAP`, or a camera."""
    pixel: Float[np.ndarray, "match 2"]
    points: Float[np.ndarray, "match 3"]
    """In the world, or in the second camera, metres."""


def _adjusted(
    frames, footage: TrackingInput, poses, room: MapViews, seed
) -> tuple[Float[np.ndarray, "placed 4 4"], Lens]:
    """Optimize the placed frames together, by what pictures show from where they are now; then the lens."""
    seen = [_view(int(frame), footage, pose, room) for frame, pose in zip(frames, poses, strict=True)]
    at, sigma = {int(frame): number for number, frame in enumerate(frames)}, SIGMA_PX / footage.lens.focal_px
    ties: list[_Tie] = []
    for number, frame in enumerate(track(frames.tolist(), "comparing pictures")):
        for walk in walk_views(seen[number], room):
            matches = _agreeing(views.flow_matches(seen[number], walk), footage.lens, seed)
            ties.append(_Tie(number, MAP, matches.pixel, matches.points_world))
        for other in (at[frame + gap] for gap in NEIGHBOURS if frame + gap in at):
            matches = _agreeing(views.flow_matches(seen[other], seen[number]), footage.lens, seed)
            points_camera = rigid.apply(rigid.inverse(poses[number]), matches.points_world)
            ties.append(_Tie(other, number, matches.pixel, points_camera))

    def find(current, reach_m):
        return Correspondences.join(*(_across(tie, current, sigma, footage.lens) for tie in ties))

    poses = optimize_poses(poses, find, None, reach_m=REACH_M).world_from_camera
    mapped = [tie for tie in ties if tie.second == MAP and len(tie.pixel)]
    placed = []
    for tie in (mapped[number] for number in subsampling.evenly(len(mapped), lenses.FRAMES)):
        matches = Matches(tie.pixel, tie.points)
        placed.append(Located(poses[tie.first], matches, 1.0, footage.lens.focal_px))
    return poses, lenses.adjusted(footage.lens, placed, bend=False) if placed else footage.lens


def _agreeing(matches: Matches, lens: Lens, seed) -> Matches:
    """Keep the matches that one camera explains."""
    found = locate(matches, lens, seed, within_px=GATE_PX)
    return Matches(np.zeros((0, 2)), np.zeros((0, 3))) if found is None else found.matches


def _across(tie: _Tie, current, sigma, lens: Lens) -> Correspondences:
    """Return a tie across its rays, from where the cameras are now."""
    first, second, pixel, points = tie.first, tie.second, tie.pixel, tie.points
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
