"""Tables: intervals over seeds and episodes, paired differences, and formatting."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.behavior.scenes import Scenes
from pipeline.metrics import intervals
from stages.tabulate_behavior import printing, tables, untrained
from stages.tabulate_behavior.reading import MethodScores
from tests.pipeline.behavior.wandering import room, wandering

WINDOWS = np.stack([np.zeros(640, int), np.arange(640)], axis=1)


def scores(values):
    return MethodScores(
        WINDOWS, WINDOWS, {"end_to_end/goal_minde_m": values, "flees/seen": np.ones((len(values), 7))}
    )


def test_intervals_include_the_variance_between_seeds():
    rng = np.random.default_rng(0)
    windows = rng.normal(1, 0.01, (3, 640))
    alike = tables.interval(windows, WINDOWS, 64, 0)
    apart = tables.interval(windows + np.array([[-0.3], [0], [0.3]]), WINDOWS, 64, 0)
    assert alike.mean == pytest.approx(apart.mean)
    assert apart.high - apart.low > 10 * (alike.high - alike.low)


def test_intervals_of_few_episodes_cover_the_truth(monkeypatch):
    monkeypatch.setattr(intervals, "BOOTSTRAP_DRAWS", 500)
    rng, window = np.random.default_rng(0), np.stack([np.zeros(6, int), 64 * np.arange(6)], axis=1)
    found = [tables.interval(rng.normal(size=(1, 6)), window, 64, seed) for seed in range(400)]
    assert np.mean([each.low <= 0 <= each.high for each in found]) > 0.92


def test_differences_are_paired_per_window():
    rng = np.random.default_rng(1)
    hard = np.repeat(rng.gamma(1, 1, 10), 64)[None] * np.ones((2, 1))
    found = tables.figures({"ats": scores(hard), "baseline": scores(hard + 0.1)}, "ats", seed=0)
    assert found["behavior/ats_minus_baseline/goal_minde_m_ci95_high"] == pytest.approx(-0.1, abs=1e-9)
    assert found["behavior/ats/goal_minde_m_ci95_high"] > found["behavior/baseline/goal_minde_m_ci95_low"]
    assert found["behavior/ats/flees_seen"] == 1
    text = printing.tables(found, ("ats", "baseline"))
    assert f"{found['behavior/baseline/goal_minde_m']:.3f}" in text


def test_flight_rate_is_compared_with_that_of_the_animal():
    values = {
        "flees/seen": np.full((2, 40), 0.75),
        "flees/true": np.ones((2, 40)),
        "flees/unseen": np.tile([0.0, 1.0], (2, 20)),
    }
    found = tables.figures({"ats": MethodScores(WINDOWS, WINDOWS, values)}, "ats", seed=0)
    assert found["behavior/ats/flees_seen_minus_true_ci95_high"] == -0.25
    assert found["behavior/ats/flees_seen_minus_unseen"] == 0.25
    assert found["behavior/ats/flees_seen_minus_unseen_ci95_low"] < 0.2


def test_plateau_detection():
    step = np.arange(200.0)
    found = tables.plateaus({"a": {"goal": np.ones((2, 200))}, "b": {"goal": (300 - step)[None]}})
    assert found["behavior/a/goal_loss_still_falls"] == 0
    assert found["behavior/b/goal_loss_still_falls"] > 0.1


def test_untrained_baselines_use_the_same_windows_and_number_of_samples():
    data = wandering()
    test = np.flatnonzero(data.split == 1)[::5]
    like = MethodScores(
        np.stack([data.video[test], data.start[test]], 1),
        np.stack([data.video[test[::2]], data.start[test[::2]]], 1),
        {},
    )
    found = untrained.scores(data, None, like, trials=2, seed=0)
    assert found["stand_still"].values["end_to_end/path_minade_m"].shape == (1, len(test[::2]))
    assert found["location_prior"].values["end_to_end/goal_minde_m"].shape == (1, len(test))
    assert "end_to_end/path_minade_m" not in found["location_prior"].values
    again = untrained.scores(data, None, replace(like, samples=64), trials=2, seed=0)
    better = [
        again[name].values["end_to_end/goal_minde_m"].mean()
        < found[name].values["end_to_end/goal_minde_m"].mean()
        for name in found
    ]
    assert all(better)


def test_untrained_baselines_are_moved_out_of_solids_where_plans_are():
    data, volume = wandering(), room()
    test = np.flatnonzero(data.split == 1)[::5]
    window = np.stack([data.video[test], data.start[test]], 1)
    like, scenes = MethodScores(window, window, {}), Scenes.of(volume)
    free, corrected = (untrained.scores(data, places, like, trials=1, seed=0) for places in (None, scenes))
    for name in free:
        pairs = [each[name].values for each in (free, corrected)]
        for score in (score for score in pairs[0] if score.startswith("networks/")):
            np.testing.assert_array_equal(pairs[0][score], pairs[1][score])
            np.testing.assert_array_equal(pairs[0][score], pairs[0][score.replace("networks", "end_to_end")])
    goal_m = [
        found["constant_velocity"].values["end_to_end/goal_energy_score_m"].mean()
        for found in (free, corrected)
    ]
    assert goal_m[1] < 0.9 * goal_m[0], "true goals are free, those of straight walks often are not"
