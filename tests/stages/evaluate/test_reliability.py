"""Reliability diagrams: calibrated probabilities have no calibration error, overconfident ones their excess."""

import numpy as np
import pytest

from pipeline.metrics.pose_errors import PoseErrors
from stages.evaluate.perception import Overlaps, mask_metrics
from stages.evaluate.registration import GOOD_ROOT, is_right
from stages.evaluate.reliability import reliability_metrics


def test_calibrated_and_overconfident_probabilities():
    rng = np.random.default_rng(0)
    probability = rng.uniform(0, 1, 20000)
    honest = reliability_metrics("x", probability, rng.random(20000) < probability).values
    assert honest["x/calibration_error"] < 0.02
    boasting = reliability_metrics("x", np.full(1000, 0.95), np.arange(1000) % 2 == 0)
    assert boasting.values["x/calibration_error"] == pytest.approx(0.45)
    assert boasting.values["x/confidence_mean"] == pytest.approx(0.95)
    (picture,) = boasting.charts.values()
    assert (picture.min(-1) < 200).any()


def test_points_are_not_clipped_and_captions_have_no_raw_keys():
    sure = reliability_metrics("x/agent", np.ones(100), np.ones(100, bool))
    unsure = reliability_metrics("x/agent", np.full(100, 0.5), np.arange(100) % 4 == 0)
    (caption,), area = sure.charts, []
    for picture in (*sure.charts.values(), *unsure.charts.values()):
        area.append(int((picture[..., 2].astype(int) - picture[..., 0] > 60).sum()))
    assert area[0] == pytest.approx(area[1], rel=0.1), "pixels"
    assert caption.startswith("x of the animal: ")


def test_empty_measurements_have_no_error():
    assert reliability_metrics("x", np.zeros(0), np.zeros(0, bool)).values == {
        "x/confidence_mean": None,
        "x/calibration_error": None,
    }


def test_mask_confidence_is_compared_with_iou():
    iou = np.array([0.9, 0.8, 0.2, 0.1])
    overlaps = Overlaps(iou, np.zeros(4, bool), np.array([1.0, 1.0, 0.0, 0.0]), np.zeros(4))
    honest = mask_metrics([overlaps], None)
    assert honest.values["masks/calibration_error"] == 0 and honest.values["masks/confidence_mean"] == 0.5
    boasting = mask_metrics([Overlaps(iou, np.zeros(4, bool), np.ones(4), np.zeros(4))], None)
    assert boasting.values["masks/calibration_error"] == pytest.approx(0.5)
    assert len(boasting.charts) == 1


def test_roots_are_correct_within_their_limits():
    errors = PoseErrors(np.array([10.0, 30.0, np.inf]), np.array([0.05, 0.01, np.inf]))
    assert is_right(errors, GOOD_ROOT).tolist() == [True, False, False]
    assert not is_right(errors).any()
