"""Voting for a common transform: robustness to outliers, and rejection with a reason."""

import numpy as np

from pipeline.geometry import rigid
from pipeline.localization.localizer import PoseHypothesis
from pipeline.mapping.pose_optimization import odometry_factors
from pipeline.mapping.visual_odometry import Odometry
from stages.register_videos import odometry
from stages.register_videos import votes as voting
from stages.register_videos.config import VoteConfig
from tests.stages.textured_room import UP, drifting, walk


def cast(truth, frames, wrong, rng) -> voting.FrameVotes:
    """Return votes with noise of 1 degree and 2 cm, and random outliers."""
    hypotheses = []
    for frame, bad in zip(frames, wrong, strict=True):
        pose = truth[frame] @ rigid.exp(rng.normal(0, 1, 6) * ([np.deg2rad(1.0)] * 3 + [0.02] * 3))
        if bad:
            pose = rigid.exp(np.concatenate([UP * rng.uniform(-3, 3), rng.uniform(-1, 1, 3)])) @ pose
        hypotheses.append(PoseHypothesis(pose, 0.4, 0.4 if bad else 0.8, np.zeros((0, 3)), np.zeros((0, 3))))
    return voting.FrameVotes(frames, hypotheses, len(frames), hypotheses[0])


def test_one_motion_is_found_among_wrong_votes():
    rng, truth = np.random.default_rng(0), walk(60)
    frames = np.arange(2, 60, 5)
    wrong = rng.random(len(frames)) < 0.5
    drifted = drifting(truth, 4)
    agreement = voting.find_agreement(cast(truth, frames, wrong, rng), drifted, True, VoteConfig())
    carried = agreement.world_from_odometry @ drifted
    assert np.rad2deg(rigid.rotation_angle(carried[:, :3, :3], truth[:, :3, :3])).max() < 3.0, (
        "degrees, drift included"
    )
    assert np.linalg.norm(carried[:, :3, 3] - truth[:, :3, 3], axis=1).max() < 0.12, "meters"
    assert (agreement.inliers == ~wrong).mean() > 0.9
    assert agreement.world_from_odometry[1, 1] > 1 - 1e-9, "gravity stays"


def test_scattered_votes_are_rejected():
    rng, truth, options = np.random.default_rng(1), walk(60), VoteConfig()
    frames = np.arange(2, 60, 5)
    votes = cast(truth, frames, np.ones(len(frames), bool), rng)
    agreement = voting.find_agreement(votes, drifting(truth, 4), True, options)
    assert "agree" in voting.rejection_reason(votes, agreement.inliers if agreement else None)
    few = voting.FrameVotes(frames[:1], votes.hypotheses[:1], 12, votes.nearest)
    assert "recognized" in voting.rejection_reason(few, None)


def broken_odometry(truth, jump_at) -> Odometry:
    """Return drifting odometry with one jump."""
    poses, jumps = drifting(truth, 5), np.zeros(len(truth), bool)
    jumps[jump_at] = True
    poses[jump_at:] = rigid.exp(np.array([0, 0.5, 0, 0.3, 0, 0.2])) @ poses[jump_at:]
    factors = odometry_factors(np.arange(len(truth)) * 0.1, poses, drift_rad_s=0.01, drift_m_s=0.01)
    return Odometry(poses, jumps, factors)


def test_votes_without_odometry_use_visual_odometry_and_drop_outliers():
    rng, truth, options = np.random.default_rng(2), walk(60), VoteConfig()
    frames = np.arange(2, 60, 5)
    wrong = np.isin(np.arange(len(frames)), [3, 8])
    votes = cast(truth, frames, wrong, rng)
    for index in np.flatnonzero(wrong):
        votes.hypotheses[index].map_from_camera[:3, 3] += 3.0
    motion, time = broken_odometry(truth, 31), np.arange(60) * 0.1
    inliers = odometry.consistent_votes(votes, time, motion, options)
    assert (inliers == ~wrong).all()
    poses = odometry.propagate_votes(votes, inliers, time, motion)
    error = np.linalg.norm(poses[:, :3, 3] - truth[:, :3, 3], axis=1)
    assert np.median(error) < 0.04, "meters"
    assert error.max() < 0.15, "meters, the jump included"
