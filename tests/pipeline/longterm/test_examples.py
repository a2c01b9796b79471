"""Reconstructed sessions are split as they were recorded."""

from pathlib import Path

import numpy as np

from pipeline.behavior.trajectories import BehaviorData
from pipeline.longterm.examples import reconstructed_split
from tests.stages.export_simulator import small_world


def test_training_sessions_too_short_for_a_window_are_learned(tmp_path: Path) -> None:
    small_world.write_surfaces(tmp_path)
    tracks = {"long": small_world.trajectory(120, 0), "short": small_world.trajectory(40, 1)}
    tracks["test"] = small_world.trajectory(40, 2)
    none, tested = np.zeros(0, np.int32), np.array([False, False, True])
    data = BehaviorData(tracks, small_world.rest(), none, none, tested, tuple(tracks)).sliced()
    assert set(data.video) == {0}, "a window takes 6.4 s"
    split = reconstructed_split(tmp_path, data)
    assert len(split.train.stretches) == 2 and split.kinds == ("test",)
