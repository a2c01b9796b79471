"""Frame selection by time: no duplicates, true timestamps, gaps preserved."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from pipeline.recordings.extraction import choose_frames


@settings(max_examples=60, deadline=None)
@given(st.lists(st.floats(0.004, 0.6), min_size=1, max_size=120), st.sampled_from([5.0, 10.0, 30.0]))
def test_every_tick_with_a_frame_gets_its_nearest_one(steps_s, rate_hz):
    timestamp_s = np.concatenate([[0.0], np.cumsum(steps_s)])
    chosen = choose_frames(timestamp_s, rate_hz)
    assert np.all(np.diff(chosen) > 0)
    tick = np.rint(timestamp_s * rate_hz)
    assert len(chosen) == len(set(tick))
    for index in chosen:
        baselines = np.abs(timestamp_s[tick == tick[index]] - tick[index] / rate_hz)
        assert abs(timestamp_s[index] - tick[index] / rate_hz) == baselines.min() <= 0.5 / rate_hz + 1e-9


def test_gaps_are_preserved():
    timestamp_s = np.concatenate([np.arange(0, 0.95, 1 / 30), np.arange(2, 2.95, 1 / 30)])
    chosen_s = timestamp_s[choose_frames(timestamp_s, 10.0)]
    assert len(chosen_s) == 20
    assert np.diff(chosen_s).max() > 1.0
