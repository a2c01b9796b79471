"""The split into training and test is the same for all horizons."""

from dataclasses import replace

import numpy as np

from pipeline.behavior.trajectories import FUTURE, TEST
from tests.pipeline.behavior.wandering import wandering


def test_recordings_without_windows_have_none_at_any_horizon():
    data = wandering()
    seen = data.video != 2
    data = replace(data, video=data.video[seen], start=data.start[seen], split=data.split[seen])
    shorter = data.with_horizon(FUTURE // 2)
    assert set(shorter.video) == {0, 1}
    assert len(shorter.start) > len(data.start)


def test_split_is_independent_of_the_horizon():
    data = wandering()
    shorter = data.with_horizon(FUTURE // 2)
    assert np.array_equal(shorter.split == TEST, shorter.video == 2)
