"""Pose confidence from covariance and from appearance compared with decoy poses."""

import numpy as np
import pytest

from pipeline.geometry import rigid
from stages.register_videos import confidence


def test_near_probability_equals_a_monte_carlo_estimate():
    rng = np.random.default_rng(0)
    sigma = (
        np.array([0.5, 1.0, 3.0])[:, None] * np.array([confidence.TOL_RAD] * 3 + [confidence.TOL_M] * 3) / 2
    )
    pose_covariance = np.einsum("fi,ij->fij", sigma**2, np.eye(6))
    found = confidence.within_tolerance(pose_covariance, rng, draws=4000)
    drawn = rng.normal(size=(3, 20000, 6)) * sigma[:, None]
    near = (np.linalg.norm(drawn[..., :3], axis=-1) < confidence.TOL_RAD) & (
        np.linalg.norm(drawn[..., 3:], axis=-1) < confidence.TOL_M
    )
    assert np.abs(found - near.mean(1)).max() < 0.04


@pytest.mark.parametrize(("right", "low", "high"), [(1.0, 0.9, 1.0), (0.0, 0.0, 0.1), (0.5, 0.35, 0.6)])
def test_poses_that_look_like_decoys_have_low_confidence(right, low, high):
    rng = np.random.default_rng(1)
    decoys = rng.normal(0.1, 0.15, 100)
    targets = np.where(np.arange(400) < right * 400, rng.normal(0.85, 0.05, 400), rng.normal(0.1, 0.15, 400))
    found = confidence.place_probability(targets, decoys, 3)
    assert low <= found.mean() <= high
    assert np.corrcoef(found, targets)[0, 1] > 0.9 or right in (0.0, 1.0)


def test_confidence_without_comparison_is_zero():
    assert (confidence.place_probability(np.full(5, np.nan), np.array([0.1]), 3) == 0).all()
    assert (confidence.place_probability(np.full(5, 0.9), np.array([np.nan]), 3) < 0.2).all(), (
        "no decoy, no evidence"
    )


def test_decoys_are_wrong():
    twist = confidence._decoy_twists(120, np.random.default_rng(0))
    turned, stepped = (
        np.linalg.norm(twist[:, :3], axis=1) / confidence.TOL_RAD,
        np.linalg.norm(twist[:, 3:], axis=1) / confidence.TOL_M,
    )
    assert np.maximum(turned, stepped).min() > 1.49
    assert np.allclose(rigid.log(rigid.exp(twist))[:, 3:], twist[:, 3:], atol=1e-6)


def test_averages_are_unknown_far_from_samples():
    time = np.arange(20.0)
    found = confidence.kernel_mean(time, time[:5], np.linspace(0, 1, 5), 1.0)
    assert found[2] == pytest.approx(0.5, abs=0.02)
    assert np.isnan(found[12:]).all()
