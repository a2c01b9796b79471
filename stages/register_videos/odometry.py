"""The odometry of a session, by its device or by its pictures, and votes propagated along it.

An unknown motion (darkness, a cut, a tracking jump) divides the recording into pieces; votes agree only
within a piece.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Bool, Float

from pipeline.core.progress import track
from pipeline.data.clips import Clip, Masks, usable_depth
from pipeline.geometry import rigid
from pipeline.mapping import pose_optimization, visual_odometry
from pipeline.mapping.odometry import JUMP_INFLATION, find_jumps, repair
from pipeline.mapping.visual_odometry import Odometry
from stages.register_videos.config import VoteConfig
from stages.register_videos.votes import FrameVotes, close

DRIFT_RAD_S, DRIFT_M_S = np.deg2rad(0.15), 0.01
"""Drift of a phone's odometry, radians and metres per second."""
NEAR_S = 6.0
"""FrameVotes of broken odometry must agree with others as near as this, seconds."""
ACROSS_JUMP = 1e-3
"""Weight of a vote on the other side of a jump against one on this side."""
SHORTEST_S = 1e-3
"""Least time to a vote, seconds."""


def of_pictures(clip: Clip, masks: Masks, rng: np.random.Generator) -> Odometry:
    """Return visual odometry, the agent masked out."""

    def view(frame: int) -> visual_odometry.FlowFrame:
        depth = usable_depth(clip, frame)
        return visual_odometry.prepare_frame(
            clip.color(frame), depth, clip.intrinsics[frame], clip.depth_intrinsics[frame], masks[frame] == 0
        )

    return visual_odometry.chain_motions(
        (view(frame) for frame in track(range(len(clip)), "visual odometry")), rng
    )


def of_device(clip: Clip) -> Odometry:
    """Return the device's odometry, repaired at tracking jumps and hardly weighted there."""
    assert clip.odometry_from_camera is not None, "the recording has odometry"
    jumps = find_jumps(clip.timestamp_s, clip.odometry_from_camera)
    poses = repair(clip.timestamp_s, clip.odometry_from_camera, jumps)
    factors = pose_optimization.odometry_factors(
        clip.timestamp_s, poses, drift_rad_s=DRIFT_RAD_S, drift_m_s=DRIFT_M_S
    )
    inflation = np.where(jumps, JUMP_INFLATION, 1.0)[1:]
    turning, moving = inflation * factors.sigma_rad, inflation * factors.sigma_m
    return Odometry(poses, jumps, replace(factors, sigma_rad=turning, sigma_m=moving))


def consistent_votes(
    votes: FrameVotes, timestamp_s: Float[np.ndarray, "frame"], motion: Odometry, config: VoteConfig
) -> Bool[np.ndarray, "vote"]:
    """Return which votes most of the others near in time confirm, carried along by what was motion."""
    voted = votes.world_from_camera
    time = timestamp_s[votes.frame]
    piece = np.cumsum(motion.jumps)[votes.frame]
    odometry, supports = motion.odometry_from_camera[votes.frame], np.zeros(len(voted), bool)
    first, last = (np.searchsorted(time, time - NEAR_S, side="right"), np.searchsorted(time, time + NEAR_S))
    for vote in range(len(voted)):
        near = np.arange(first[vote], last[vote])
        near = near[(piece[near] == piece[vote]) & (near != vote)]
        propagated = voted[near] @ rigid.inverse(odometry[near]) @ odometry[vote]
        agreeing = close(propagated, voted[vote], config)
        supports[vote] = (
            agreeing.any()
            and (agreeing * votes.probability[near]).sum() >= 0.5 * votes.probability[near].sum()
        )
    return supports


def anchored(
    votes: FrameVotes, supports: Bool[np.ndarray, "vote"], motion: Odometry
) -> Bool[np.ndarray, "frame"]:
    """Return which frames lie in a piece with at least one agreeing vote; the others are interpolated."""
    piece = np.cumsum(motion.jumps)
    return np.isin(piece, piece[votes.frame[supports]])


def propagate_votes(
    votes: FrameVotes,
    supports: Bool[np.ndarray, "vote"],
    timestamp_s: Float[np.ndarray, "frame"],
    motion: Odometry,
) -> Float[np.ndarray, "frame 4 4"]:
    """Return poses propagated from the votes around each frame and blended; across a jump, interpolated."""
    frame, voted = votes.frame[supports], votes.world_from_camera[supports]
    odometry, piece = motion.odometry_from_camera, np.cumsum(motion.jumps)
    world_from_odometry = voted @ rigid.inverse(odometry[frame])
    after = np.minimum(np.searchsorted(frame, np.arange(len(timestamp_s))), len(frame) - 1)
    before = np.maximum(np.searchsorted(frame, np.arange(len(timestamp_s)), side="right") - 1, 0)
    ends, closeness = [], []
    for vote in (before, after):
        same = piece[frame[vote]] == piece
        ends.append(np.where(same[:, None, None], world_from_odometry[vote] @ odometry, voted[vote]))
        closeness.append(
            np.where(same, 1.0, ACROSS_JUMP) / (np.abs(timestamp_s - timestamp_s[frame[vote]]) + SHORTEST_S)
        )
    share = closeness[1] / (closeness[0] + closeness[1])
    return ends[0] @ rigid.exp(rigid.log(rigid.inverse(ends[0]) @ ends[1]) * share[:, None])
