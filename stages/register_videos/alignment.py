"""Align a whole recording to the template at once: odometry, votes, depth, flow and features in one robust
optimization.

Depth constrains every frame along surface normals (the agent masked out, moved furniture down-weighted);
votes constrain points; in further passes optical flow and features between the rendered template and the
picture constrain what depth leaves free to slide along walls.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float

from pipeline.core.progress import track
from pipeline.data.clips import Clip, Masks
from pipeline.geometry import rigid, subsampling
from pipeline.geometry.meshes import RayCaster
from pipeline.mapping import depth_scans, pose_optimization
from pipeline.mapping.pose_optimization import Correspondences, RelativePoseFactors, optimize_poses
from stages.register_videos.config import AlignmentConfig
from stages.register_videos.feature_alignment import FeatureMap, feature_correspondences
from stages.register_videos.flow_alignment import flow_correspondences
from stages.register_videos.point_alignment import Walk, WalkTerm
from stages.register_videos.votes import FrameVotes

MAX_POINTS, MIN_POINTS = 400_000, 40
"""Depth points of a recording that take part, and as many correspondences of flow and of features, so that
memory stays bounded; least number per frame."""
DEPTH_INFLATION = 8.0
"""Depth noise is multiplied by this, since neighbouring pixels err together and furniture moves."""
VOTE_SIGMA_M = 0.15
"""Standard deviation of one matched patch of a vote, metres."""
FIRST_REACH_M, LAST_REACH_M = 0.3, 0.04
"""Width of the robust weight in the first and last round, metres."""
VOTE_ROUNDS, PICTURE_ROUNDS = 3, 3
"""Gauss-Newton steps by votes alone, and with the correspondences of each pass over the pictures."""
FEATURE_PASSES = 2
"""Features are compared anew so often: each pass moves by less than a cell."""
MASK_MARGIN_PX = 7
"""The agent's mask is widened by a square of this size, depth pixels: depth bleeds across outlines."""
MEASURABLE_POINTS = 20
"""Points of static depth without which a frame's fit is unknown."""
NEAR_M, FITS_M = 0.5, 0.05
"""Depth farther from the surface than the first is of something else; within the second it fits, metres."""


@dataclass(frozen=True)
class AlignedCameras:
    """The aligned cameras and how well each frame's depth fits."""

    world_from_camera: Float[np.ndarray, "frame 4 4"]
    pose_covariance: Float[np.ndarray, "frame 6 6"]
    """Covariance of each camera's right-hand twist (rotation in radians, translation in metres)."""
    gap_m: Float[np.ndarray, "frame"]
    """Median distance of the static depth from the surface; NaN where nothing was in reach."""
    fit: Float[np.ndarray, "frame"]
    """Share of the static depth within 5 cm of the surface, of what lies within half a metre of it; NaN where
    there is no static depth to measure."""

    @property
    def median_gap_m(self) -> float:
        """Return the median frame's gap, metres; NaN where no frame was measured."""
        return _median(self.gap_m)

    @property
    def median_fit(self) -> float:
        """Return the median frame's fit; NaN where no frame was measured."""
        return _median(self.fit)


def align(
    clip: Clip,
    masks: Masks,
    caster: RayCaster,
    features: FeatureMap | None,
    world_from_camera: Float[np.ndarray, "frame 4 4"],
    odometry: RelativePoseFactors,
    votes: FrameVotes,
    supports: Bool[np.ndarray, "vote"],
    config: AlignmentConfig,
    walk: Walk | None = None,
) -> AlignedCameras:
    """Optimize all frames: votes and odometry, then depth from coarse to fine, then flow, points of the walk,
    and features.
    """
    surface, frames = depth_scans.SurfaceMap(caster.mesh), np.arange(len(clip))
    most = max(MAX_POINTS // len(clip), MIN_POINTS)
    scans = [
        _static_scan(clip, masks, int(frame), config.stride_px, most) for frame in track(frames, "depth")
    ]
    voted = _vote_correspondences(votes, supports)
    by_flow: list[Correspondences] = []
    by_features: list[Correspondences] = []

    def find(poses, reach_m):
        depth = surface.correspondences(frames, scans, poses, reach_m, DEPTH_INFLATION)
        return Correspondences.join(depth, *voted, *by_flow, *by_features)

    poses, last, points = world_from_camera, (LAST_REACH_M,) * PICTURE_ROUNDS, None
    if config.rounds:
        if voted:
            first = (FIRST_REACH_M,) * VOTE_ROUNDS
            poses = optimize_poses(
                poses, lambda *_: Correspondences.join(*voted), odometry, reach_m=first
            ).world_from_camera
        reach = tuple(np.geomspace(FIRST_REACH_M, LAST_REACH_M, config.rounds))
        poses = optimize_poses(poses, find, odometry, reach_m=reach).world_from_camera
    if config.flow_every_frames:
        chosen = frames[:: config.flow_every_frames]
        by_flow[:] = _ties(flow_correspondences, "optical flow", clip, masks, caster, chosen, poses)
        poses = optimize_poses(poses, find, odometry, reach_m=last).world_from_camera
    if walk is not None:
        points = WalkTerm(clip, masks, poses, walk)
        poses = optimize_poses(poses, find, odometry, reach_m=2 * last, term=points).world_from_camera
    for _ in range(FEATURE_PASSES if features is not None and config.feature_every_frames else 0):
        chosen = frames[:: config.feature_every_frames]
        by_features[:] = _ties(feature_correspondences, "features", clip, masks, features, chosen, poses)
        poses = optimize_poses(poses, find, odometry, reach_m=last, term=points).world_from_camera
    covariance = pose_optimization.marginal_covariance(
        poses, find(poses, LAST_REACH_M), odometry, LAST_REACH_M
    )
    return AlignedCameras(poses, covariance, *measure_fit(surface, scans, poses))


def keep(
    clip: Clip,
    masks: Masks,
    caster: RayCaster,
    world_from_camera: Float[np.ndarray, "frame 4 4"],
    odometry: RelativePoseFactors,
    config: AlignmentConfig,
) -> AlignedCameras:
    """Keep cameras that the map itself gave, and measure how well optical flow from it holds them.

    Depth that was cast from these very cameras would confirm them whatever they are, so none takes part.
    """
    chosen = track(range(0, len(clip), max(config.flow_every_frames, 1)), "optical flow")
    found = (flow_correspondences(clip, masks, caster, frame, world_from_camera[frame]) for frame in chosen)
    ties = [tie for tie in found if tie is not None]
    unknown = np.full(len(clip), np.nan)
    covariance = np.repeat(np.eye(6)[None], len(clip), axis=0)
    if ties:
        covariance = pose_optimization.marginal_covariance(
            world_from_camera, Correspondences.join(*ties), odometry, LAST_REACH_M
        )
    return AlignedCameras(world_from_camera, covariance, unknown, unknown)


def measure_fit(
    surface: depth_scans.SurfaceMap,
    scans: list[depth_scans.Scan],
    world_from_camera: Float[np.ndarray, "frame 4 4"],
) -> tuple[Float[np.ndarray, "frame"], Float[np.ndarray, "frame"]]:
    """Return each frame's median gap (metres) and the share of its depth within 5 cm of the surface, of that
    within 50 cm; NaN for frames that measured too few points, and no share at all where they lie nowhere
    near."""
    gap, fit = np.full(len(scans), np.nan), np.full(len(scans), np.nan)
    for frame, scan in enumerate(scans):
        if len(scan.points_camera) >= MEASURABLE_POINTS:
            distance = np.abs(surface.distance(rigid.apply(world_from_camera[frame], scan.points_camera)))
            near, fit[frame] = distance[distance < NEAR_M], 0.0
            if len(near) >= MEASURABLE_POINTS:
                gap[frame], fit[frame] = np.median(near), (near < FITS_M).mean()
    return gap, fit


def _median(values):
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else float("nan")


def _ties(find, label, clip, masks, template, chosen, poses) -> list[Correspondences]:
    """Return the correspondences of the chosen frames that have any, so many that memory stays bounded."""
    most = max(MAX_POINTS // len(chosen), MIN_POINTS)
    ties = (find(clip, masks, template, frame, poses[frame]) for frame in track(chosen.tolist(), label))
    return [tie.selected(subsampling.evenly(len(tie.first), most)) for tie in ties if tie is not None]


def _static_scan(clip, masks, frame, stride_px, most):
    """Return the subsampled depth of what is not the animal."""
    agent = (masks[frame] > 0).astype(np.uint8)
    ignore = cv2.resize(agent, clip.depth_size[::-1], interpolation=cv2.INTER_NEAREST)
    return depth_scans.scan(
        clip.depth(frame),
        clip.depth_intrinsics[frame],
        stride=stride_px,
        confidence=clip.confidence(frame),
        ignore=cv2.dilate(ignore, np.ones((MASK_MARGIN_PX, MASK_MARGIN_PX), np.uint8)) > 0,
    ).subsampled(most)


def _vote_correspondences(votes, supports):
    """Match the inlier patches of each agreeing vote, along all three axes."""
    matches = []
    for vote in np.flatnonzero(supports):
        answer = votes.answers[vote]
        count = len(answer.points_map)
        first, second = np.full(count, votes.frame[vote]), np.full(count, pose_optimization.MAP)
        sigma = np.full(count, VOTE_SIGMA_M)
        for axis in np.eye(3):
            direction = np.broadcast_to(axis, (count, 3))
            matches.append(
                Correspondences(first, second, answer.points_camera, answer.points_map, direction, sigma)
            )
    return matches
