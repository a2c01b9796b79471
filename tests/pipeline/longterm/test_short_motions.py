import numpy as np
import pytest

from pipeline.behavior.trajectories import Trajectory
from pipeline.geometry import rigid
from pipeline.longterm.short_motions import (
    BodyMotion,
    concatenate_motions,
    jump_between_levels,
    limit_turn_rate,
    resample_motion,
    stretches,
)


def turning(time_s):
    """A smooth path with a constant turn rate."""
    vector = np.zeros((len(time_s), 3))
    vector[:, 1] = 0.8 * time_s
    return rigid.make(
        rigid.rotation_from_vector(vector),
        np.stack([np.sin(time_s), 0 * time_s, np.cos(2 * time_s)], axis=-1),
    )


def test_upsampled_motion_follows_the_curve():
    coarse, fine = np.arange(41) / 10, np.arange(121) / 30
    moving = resample_motion(coarse, BodyMotion(turning(coarse), turning(coarse)[:, None]))
    assert len(moving) == 121
    np.testing.assert_allclose(
        moving.world_from_agent, turning(fine), atol=2e-3
    )  # linear interpolation is off by 5e-3
    np.testing.assert_allclose(moving.agent_from_bone[:, 0], turning(fine), atol=2e-3)


def test_segments_end_at_missing_frames():
    time_s = np.arange(100) / 10
    valid = np.ones(100, bool)
    valid[[30, 45]] = False
    root = turning(time_s)
    found = stretches(Trajectory(time_s, root, root[:, None], root, valid))
    assert [len(part) for part in found] == [88, 160]
    np.testing.assert_allclose(found[1].world_from_agent[0], root[46], atol=1e-9)


def test_shared_frames_occur_once():
    moving = BodyMotion(turning(np.arange(10) / 30), turning(np.arange(10) / 30)[:, None])
    whole = concatenate_motions([moving[:4], moving[3:7], moving[6:]])
    np.testing.assert_array_equal(whole.world_from_agent, moving.world_from_agent)
    assert len(concatenate_motions([moving])) == pytest.approx(10)


def test_leap_rises_before_and_descends_after_crossing():
    roots = np.tile(np.eye(4), (61, 1, 1))
    roots[:, :3, 3] = np.linspace(0, 1, 61)[:, None] * [1.0, 0.5, 0.0]
    up = jump_between_levels(BodyMotion(roots, np.tile(np.eye(4), (61, 2, 1, 1))))
    down = jump_between_levels(BodyMotion(roots[::-1], up.agent_from_bone))
    for motion in (up, BodyMotion(down.world_from_agent[::-1], down.agent_from_bone)):
        place = motion.world_from_agent[:, :3, 3]
        np.testing.assert_allclose(place[[0, -1]], roots[[0, -1], :3, 3], atol=1e-9)
        assert place[place[:, 0] > 0.2, 1].min() > 0.4, "over the edge it is up"
        assert np.linalg.norm(np.diff(place, 2, axis=0), axis=1).max() < 0.02


def test_heading_flip_becomes_a_rate_limited_turn():
    yaw = np.where(np.arange(61) < 30, 0.0, 3.0) + np.linspace(0, 0.1, 61)
    roots = rigid.make(rigid.rotation_from_vector(yaw[:, None] * [0.0, 1.0, 0.0]), np.zeros((61, 3)))
    made = limit_turn_rate(BodyMotion(roots, roots[:, None]), 0.2).world_from_agent[:, :3, :3]
    assert rigid.rotation_angle(made[:-1], made[1:]).max() < 0.2 + 1e-6
    np.testing.assert_allclose(made[[0, -1]], roots[[0, -1], :3, :3], atol=1e-6)
    assert rigid.rotation_angle(made[30], roots[0, :3, :3]) == pytest.approx(1.55, abs=0.2), (
        "half of it half way"
    )
    slow = BodyMotion(turning(np.arange(61) / 30), roots[:, None])
    np.testing.assert_allclose(limit_turn_rate(slow, 0.2).world_from_agent, slow.world_from_agent, atol=1e-6)
