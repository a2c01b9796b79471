"""Refit of skinning weights to four bones: exact if four bones suffice, never worse than the four largest."""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.fields import weight_refit
from pipeline.fields.skinning import SkinnedShape
from pipeline.geometry import rigid

RNG = np.random.default_rng(0)


def world(bones: int, bend_rad: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Random bones, nearby points with soft weights, and random poses."""
    centers = RNG.normal(0, 0.15, (bones, 3))
    points = centers[RNG.integers(0, bones, 200)] + RNG.normal(0, 0.04, (200, 3))
    weights = np.exp(-((points[:, None] - centers) ** 2).sum(-1) / (2 * 0.08**2))
    rest = rigid.make(np.eye(3), centers)
    twist = RNG.normal(size=(16, bones, 6)) * [bend_rad] * 6 * np.array([1, 1, 1, 0.1, 0.1, 0.1])
    return points, weights / weights.sum(1, keepdims=True), rest, rest @ rigid.exp(twist)


@pytest.mark.parametrize("bones", [2, 4, 12])
def test_weights_are_convex_and_better_than_the_four_largest(bones: int) -> None:
    points, weights, rest, posed_bones = world(bones, 0.3)
    body = SkinnedShape(points, weights, rest)
    poses = weight_refit.Poses.of(body, posed_bones)
    fitted = weight_refit.refit_weights(body, poses)
    assert fitted.joints.shape == fitted.weights.shape == (200, 4)
    assert (fitted.weights >= 0).all()
    np.testing.assert_allclose(fitted.weights.sum(1), 1, atol=1e-6)
    heaviest = np.argsort(-weights, axis=1)[:, :4]
    plain = np.take_along_axis(weights, heaviest, 1)
    plain = (plain / plain.sum(1, keepdims=True)).astype(np.float32)
    blends = (fitted, replace(fitted, joints=heaviest.astype(np.uint8), weights=plain))
    after, before = ((weight_refit.residual_m(points, blend, poses) ** 2).mean() for blend in blends)
    assert after <= before * (1 + 1e-6)


def test_rigid_points_are_exact() -> None:
    points, weights, rest, posed_bones = world(6, 0.5)
    alone = np.eye(6)[weights.argmax(1)]
    body = SkinnedShape(points, alone, rest)
    poses = weight_refit.Poses.of(body, posed_bones)
    fitted = weight_refit.refit_weights(body, poses)
    assert weight_refit.residual_m(points, fitted, poses).max() < 1e-4, "meters: float32 blending"


def test_selected_poses_contain_the_extremes() -> None:
    turn = np.zeros((50, 1, 6))
    turn[:, 0, 0] = np.sort(RNG.uniform(-1, 1, 50))
    chosen = weight_refit.farthest_poses(rigid.exp(turn), 5)
    assert len(chosen) == 5 and {0, 49} <= set(chosen.tolist())
    assert len(weight_refit.farthest_poses(rigid.exp(turn), 80)) == 50
