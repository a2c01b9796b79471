import numpy as np
import pytest

from pipeline.models.short_motions import Moving, joined, resampled, stretches
from pipeline.models.trajectories import Trajectory
from pipeline.space import rigid


def turning(time_s):
    """A smooth path that turns at an even rate."""
    vector = np.zeros((len(time_s), 3))
    vector[:, 1] = 0.8 * time_s
    return rigid.make(rigid.rotation_from_vector(vector), np.stack([np.sin(time_s), 0 * time_s, np.cos(2 * time_s)], axis=-1))


def test_thirty_frames_a_second_follow_the_curve():
    coarse, fine = np.arange(41) / 10, np.arange(121) / 30
    moving = resampled(coarse, Moving(turning(coarse), turning(coarse)[:, None]))
    assert len(moving) == 121
    np.testing.assert_allclose(moving.world_from_agent, turning(fine), atol=2e-3)  # linear interpolation is off by 5e-3
    np.testing.assert_allclose(moving.agent_from_bone[:, 0], turning(fine), atol=2e-3)


def test_stretches_end_where_frames_are_missing():
    time_s = np.arange(100) / 10
    valid = np.ones(100, bool)
    valid[[30, 45]] = False
    root = turning(time_s)
    found = stretches(Trajectory(time_s, root, root[:, None], root, valid))
    assert [len(part) for part in found] == [88, 160]
    np.testing.assert_allclose(found[1].world_from_agent[0], root[46], atol=1e-9)


def test_joints_count_once():
    moving = Moving(turning(np.arange(10) / 30), turning(np.arange(10) / 30)[:, None])
    whole = joined([moving[:4], moving[3:7], moving[6:]])
    np.testing.assert_array_equal(whole.world_from_agent, moving.world_from_agent)
    assert len(joined([moving])) == pytest.approx(10)
