"""Split and stride of windows are the same for all horizons."""

from dataclasses import replace

import numpy as np

from pipeline.behavior.trajectories import FUTURE, PAST, TEST, TRAIN, BehaviorData
from tests.pipeline.behavior.wandering import wandering


def test_recordings_too_short_for_a_window_keep_their_split():
    data = wandering()
    short = {name: replace(track, valid=np.arange(len(track.valid)) < PAST + FUTURE // 2)
             for name, track in data.trajectories.items() if name != "v000"}  # fmt: skip
    data = replace(data, trajectories=data.trajectories | short).sliced()
    assert set(data.video) == {0} and set(data.training) == {"v000", "v001"}
    shorter = data.with_horizon(FUTURE // 2)
    assert np.bincount(shorter.video)[1:].tolist() == [1, 1]
    assert shorter.split.tolist() == [TEST if video == 2 else TRAIN for video in shorter.video]


def test_training_windows_keep_their_stride_at_other_horizons(tmp_path):
    data = replace(wandering(), stride=5).sliced()
    data.save(tmp_path)
    shorter = BehaviorData.load(tmp_path).with_horizon(FUTURE // 2)
    for each in (data, shorter):
        step = np.diff(each.start)[np.diff(each.video) == 0]
        assert set(step[each.split[1:][np.diff(each.video) == 0] == TRAIN]) == {5}
        assert set(step[each.split[1:][np.diff(each.video) == 0] == TEST]) == {1}


def test_split_is_independent_of_the_horizon():
    data = wandering()
    shorter = data.with_horizon(FUTURE // 2)
    assert np.array_equal(shorter.split == TEST, shorter.video == 2)
