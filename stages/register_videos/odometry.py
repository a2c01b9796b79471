"""Odometry of a session, from its device or its pictures, and propagation of votes along it.

Unknown motions (darkness, a cut, a tracking jump) split the recording into segments; votes are compared only
within a segment.
"""

from dataclasses import replace
from functools import partial

import numpy as np
from jaxtyping import Bool, Float

from pipeline.core.progress import track
from pipeline.data.clips import Clip, Masks, usable_depth
from pipeline.geometry import rigid
from pipeline.mapping import pose_optimization, visual_odometry
from pipeline.mapping.icp import depth_views
from pipeline.mapping.odometry import JUMP_INFLATION, JUMP_STRIDE_PX, find_jumps, repair
from pipeline.mapping.visual_odometry import Odometry
from stages.register_videos.config import VoteConfig
from stages.register_videos.votes import FrameVotes, are_close

DRIFT_RAD_S, DRIFT_M_S = np.deg2rad(0.15), 0.01
"""Drift of a phone's odometry, radians and meters per second."""
NEAR_S = 6.0
"""Votes are compared with others within this time, seconds."""
ACROSS_JUMP = 1e-3
"""Relative weight of a vote across a jump."""
MIN_TIME_S = 1e-3
"""Added to the time to a vote, seconds, against division by zero."""


def estimate_odometry(clip: Clip, masks: Masks, rng: np.random.Generator) -> Odometry:
    """Return visual odometry with the agent masked out."""

    def view(frame: int) -> visual_odometry.FlowFrame:
        depth = usable_depth(clip, frame)
        return visual_odometry.prepare_frame(
            clip.color(frame), depth, clip.intrinsics[frame], clip.depth_intrinsics[frame], masks[frame] == 0
        )

    return visual_odometry.chain_motions(
        (view(frame) for frame in track(range(len(clip)), "visual odometry")), rng
    )


def device_odometry(clip: Clip) -> Odometry:
    """Return the device's odometry, repaired at tracking jumps and down-weighted there."""
    assert clip.odometry_from_camera is not None, "the recording has odometry"
    view = depth_views(partial(usable_depth, clip), clip.depth_intrinsics, JUMP_STRIDE_PX)
    jumps = find_jumps(clip.timestamp_s, clip.odometry_from_camera, view)
    poses = repair(clip.timestamp_s, clip.odometry_from_camera, jumps)
    factors = pose_optimization.odometry_factors(
        clip.timestamp_s, poses, drift_rad_s=DRIFT_RAD_S, drift_m_s=DRIFT_M_S
    )
    inflation = np.where(jumps, JUMP_INFLATION, 1.0)[1:]
    sigma_rad, sigma_m = inflation * factors.sigma_rad, inflation * factors.sigma_m
    return Odometry(poses, jumps, replace(factors, sigma_rad=sigma_rad, sigma_m=sigma_m))


def consistent_votes(
    votes: FrameVotes, timestamp_s: Float[np.ndarray, "frame"], motion: Odometry, config: VoteConfig
) -> Bool[np.ndarray, "vote"]:
    """Return the votes that the majority of votes near in time confirm, propagated along odometry."""
    voted = votes.world_from_camera
    time = timestamp_s[votes.frame]
    segment = np.cumsum(motion.jumps)[votes.frame]
    odometry, inliers = motion.odometry_from_camera[votes.frame], np.zeros(len(voted), bool)
    first, last = (np.searchsorted(time, time - NEAR_S, side="right"), np.searchsorted(time, time + NEAR_S))
    for vote in range(len(voted)):
        near = np.arange(first[vote], last[vote])
        near = near[(segment[near] == segment[vote]) & (near != vote)]
        propagated = voted[near] @ rigid.inverse(odometry[near]) @ odometry[vote]
        agreeing = are_close(propagated, voted[vote], config)
        inliers[vote] = (
            agreeing.any()
            and (agreeing * votes.probability[near]).sum() >= 0.5 * votes.probability[near].sum()
        )
    return inliers


def propagate_votes(
    votes: FrameVotes,
    inliers: Bool[np.ndarray, "vote"],
    timestamp_s: Float[np.ndarray, "frame"],
    motion: Odometry,
) -> Float[np.ndarray, "frame 4 4"]:
    """Return poses blended from the votes before and after each frame; interpolated across jumps."""
    frame, voted = votes.frame[inliers], votes.world_from_camera[inliers]
    odometry, segment = motion.odometry_from_camera, np.cumsum(motion.jumps)
    world_from_odometry = voted @ rigid.inverse(odometry[frame])
    after = np.minimum(np.searchsorted(frame, np.arange(len(timestamp_s))), len(frame) - 1)
    before = np.maximum(np.searchsorted(frame, np.arange(len(timestamp_s)), side="right") - 1, 0)
    ends, closeness = [], []
    for vote in (before, after):
        same = segment[frame[vote]] == segment
        ends.append(np.where(same[:, None, None], world_from_odometry[vote] @ odometry, voted[vote]))
        closeness.append(
            np.where(same, 1.0, ACROSS_JUMP) / (np.abs(timestamp_s - timestamp_s[frame[vote]]) + MIN_TIME_S)
        )
    blend = closeness[1] / (closeness[0] + closeness[1])
    return ends[0] @ rigid.exp(rigid.log(rigid.inverse(ends[0]) @ ends[1]) * blend[:, None])
