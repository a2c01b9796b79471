"""Align all frames of a recording to the template in one robust optimization.

Terms are odometry, depth (point to plane, agent masked out, moved furniture down-weighted) and patch matches
of the votes. In further passes optical flow and features between rendered template and picture constrain the
directions along walls that depth leaves free.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float

from pipeline.core.progress import track
from pipeline.data.clips import Clip, Masks
from pipeline.geometry import subsampling
from pipeline.geometry.meshes import RayCaster
from pipeline.mapping import depth_scans, pose_optimization
from pipeline.mapping.pose_optimization import Correspondences, RelativePoseFactors, optimize_poses
from stages.register_videos.config import AlignmentConfig
from stages.register_videos.feature_alignment import FeatureMap, feature_correspondences
from stages.register_videos.flow_alignment import flow_correspondences
from stages.register_videos.point_alignment import Walkthrough, WalkthroughTerm
from stages.register_videos.votes import FrameVotes

MAX_POINTS, MIN_POINTS = 400_000, 40
"""Depth points per recording, and as many correspondences of flow and of features, which bounds memory; least
number per frame."""
DEPTH_INFLATION = 8.0
"""Factor on depth noise, since neighboring errors are correlated and furniture moves."""
VOTE_SIGMA_M = 0.15
"""Standard deviation of one patch match of a vote, meters."""
FIRST_REACH_M, LAST_REACH_M = 0.3, 0.04
"""Width of the robust kernel in the first and last round, meters."""
VOTE_ROUNDS, PICTURE_ROUNDS = 3, 3
"""Gauss-Newton steps by votes alone, and per pass with picture correspondences."""
FEATURE_PASSES = 2
"""Passes of feature alignment; each moves by less than a cell."""
MASK_MARGIN_PX = 7
"""Side of the square that dilates the agent's mask, depth pixels: depth bleeds across outlines."""


@dataclass(frozen=True)
class AlignedCameras:
    """The aligned cameras and how well each frame's depth fits."""

    world_from_camera: Float[np.ndarray, "frame 4 4"]
    pose_covariance: Float[np.ndarray, "frame 6 6"]
    """Covariance of each camera's right-hand twist (rotation in radians, translation in meters)."""
    gap_m: Float[np.ndarray, "frame"]
    """Median distance of static depth from the surface, meters; NaN where unknown."""
    fit: Float[np.ndarray, "frame"]
    """Share of static depth within 5 cm of the surface, among that within 50 cm; NaN where unknown."""

    @property
    def median_gap_m(self) -> float:
        """Return the median frame's gap, meters; NaN where no frame was measured."""
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
    inliers: Bool[np.ndarray, "vote"],
    config: AlignmentConfig,
    walk: Walkthrough | None = None,
) -> AlignedCameras:
    """Optimize all frames by votes and odometry, then depth, flow, walk-through points and features."""
    surface, frames = depth_scans.SurfaceMap(caster.mesh), np.arange(len(clip))
    limit = max(MAX_POINTS // len(clip), MIN_POINTS)
    scans = [
        _static_scan(clip, masks, int(frame), config.stride_px, limit) for frame in track(frames, "depth")
    ]
    voted = _vote_correspondences(votes, inliers)
    by_flow: list[Correspondences] = []
    by_features: list[Correspondences] = []

    def associate(poses, reach_m):
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
        poses = optimize_poses(poses, associate, odometry, reach_m=reach).world_from_camera
    if config.flow_every_frames:
        chosen = frames[:: config.flow_every_frames]
        by_flow[:] = _match_frames(flow_correspondences, "optical flow", clip, masks, caster, chosen, poses)
        poses = optimize_poses(poses, associate, odometry, reach_m=last).world_from_camera
    if walk is not None:
        points = WalkthroughTerm(clip, masks, poses, walk)
        poses = optimize_poses(poses, associate, odometry, reach_m=2 * last, term=points).world_from_camera
    for _ in range(FEATURE_PASSES if features is not None and config.feature_every_frames else 0):
        chosen = frames[:: config.feature_every_frames]
        by_features[:] = _match_frames(
            feature_correspondences, "features", clip, masks, features, chosen, poses
        )
        poses = optimize_poses(poses, associate, odometry, reach_m=last, term=points).world_from_camera
    covariance = pose_optimization.marginal_covariance(
        poses, associate(poses, LAST_REACH_M), odometry, LAST_REACH_M
    )
    return AlignedCameras(poses, covariance, *depth_scans.measure_fit(surface, scans, poses))


def keep_cameras(
    clip: Clip,
    masks: Masks,
    caster: RayCaster,
    world_from_camera: Float[np.ndarray, "frame 4 4"],
    odometry: RelativePoseFactors,
    config: AlignmentConfig,
) -> AlignedCameras:
    """Keep cameras that come from the map; their covariance is from optical flow alone.

    Depth rendered from these cameras always agrees with the map, so it is not used.
    """
    chosen = track(range(0, len(clip), max(config.flow_every_frames, 1)), "optical flow")
    found = (flow_correspondences(clip, masks, caster, frame, world_from_camera[frame]) for frame in chosen)
    valid = [each for each in found if each is not None]
    unknown = np.full(len(clip), np.nan)
    covariance = np.repeat(np.eye(6)[None], len(clip), axis=0)
    if valid:
        covariance = pose_optimization.marginal_covariance(
            world_from_camera, Correspondences.join(*valid), odometry, LAST_REACH_M
        )
    return AlignedCameras(world_from_camera, covariance, unknown, unknown)


def _median(values):
    known = values[np.isfinite(values)]
    return float(np.median(known)) if len(known) else float("nan")


def _match_frames(find, label, clip, masks, template, chosen, poses) -> list[Correspondences]:
    """Return the correspondences of the chosen frames, subsampled to bound memory."""
    limit = max(MAX_POINTS // len(chosen), MIN_POINTS)
    found = (find(clip, masks, template, frame, poses[frame]) for frame in track(chosen.tolist(), label))
    return [each.selected(subsampling.evenly(len(each.first), limit)) for each in found if each is not None]


def _static_scan(clip, masks, frame, stride_px, limit):
    """Return subsampled depth outside the dilated agent mask."""
    agent = (masks[frame] > 0).astype(np.uint8)
    ignore = cv2.resize(agent, clip.depth_size[::-1], interpolation=cv2.INTER_NEAREST)
    return depth_scans.scan(
        clip.depth(frame),
        clip.depth_intrinsics[frame],
        stride=stride_px,
        confidence=clip.confidence(frame),
        ignore=cv2.dilate(ignore, np.ones((MASK_MARGIN_PX, MASK_MARGIN_PX), np.uint8)) > 0,
    ).subsampled(limit)


def _vote_correspondences(votes, inliers):
    """Return point-to-point correspondences of the inlier patches of each inlier vote."""
    matches = []
    for vote in np.flatnonzero(inliers):
        pose = votes.hypotheses[vote]
        count = len(pose.points_map)
        first, second = np.full(count, votes.frame[vote]), np.full(count, pose_optimization.MAP)
        sigma = np.full(count, VOTE_SIGMA_M)
        for axis in np.eye(3):
            direction = np.broadcast_to(axis, (count, 3))
            matches.append(
                Correspondences(first, second, pose.points_camera, pose.points_map, direction, sigma)
            )
    return matches
