"""Reliability: honest probabilities have no calibration error, boasting has as much as it exceeds."""

import numpy as np
import pytest

from stages.evaluate.reliability import reliability_figures


def test_honest_and_boasting_probabilities():
    rng = np.random.default_rng(0)
    probability = rng.uniform(0, 1, 20000)
    honest = reliability_figures("x", probability, rng.random(20000) < probability).values
    assert honest["x/calibration_error"] < 0.02
    boasting = reliability_figures("x", np.full(1000, 0.95), np.arange(1000) % 2 == 0)
    assert boasting.values["x/calibration_error"] == pytest.approx(0.45)
    assert boasting.values["x/confidence_mean"] == pytest.approx(0.95)
    (picture,) = boasting.charts.values()
    assert (picture.min(-1) < 200).any()


def test_nothing_measured():
    assert reliability_figures("x", np.zeros(0), np.zeros(0, bool)).values == {"x/confidence_mean": None, "x/calibration_error": None}
