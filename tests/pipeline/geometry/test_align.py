"""Rigid alignment is exact on clean correspondences and robust to two thirds of outliers."""

import numpy as np

from pipeline.geometry import align, rigid


def test_kabsch_recovers_motions_in_a_batch():
    rng = np.random.default_rng(0)
    target_from_source = rigid.exp(rng.normal(size=(5, 6)))
    source = rng.normal(size=(5, 7, 3))
    assert np.allclose(align.kabsch(source, rigid.apply(target_from_source, source)), target_from_source)


def test_kabsch_gives_proper_rotations():
    rng = np.random.default_rng(0)
    flat = rng.normal(size=(20, 3)) * [1, 1, 0]
    assert np.linalg.det(align.kabsch(flat, flat * [-1, 1, 1])[:3, :3]) > 0.99


def test_ransac_is_robust_to_two_thirds_of_outliers():
    rng = np.random.default_rng(1)
    target_from_source = rigid.exp(rng.normal(size=6))
    source = rng.uniform(-2, 2, (300, 3))
    target = rigid.apply(target_from_source, source) + rng.normal(scale=0.005, size=source.shape)
    target[:200] = rng.uniform(-2, 2, (200, 3))
    found, inlier = align.ransac_rigid(source, target, threshold_m=0.05, iterations=600, rng=rng)
    assert np.linalg.norm(rigid.log(rigid.inverse(found) @ target_from_source)) < 0.01
    assert inlier[200:].mean() > 0.95 and inlier[:200].mean() < 0.05


def test_ransac_without_points_fails():
    transform, inlier = align.ransac_rigid(
        np.zeros((2, 3)), np.zeros((2, 3)), threshold_m=0.1, iterations=10, rng=np.random.default_rng(0)
    )
    assert np.allclose(transform, np.eye(4)) and not inlier.any()


def test_rotation_between_opposite_directions_is_a_half_turn():
    up = np.array([0.0, 1.0, 0.0])
    assert np.allclose(align.rotation_between(up, -up) @ up, -up)
    assert np.allclose(
        align.rotation_between(up, np.array([1.0, 1.0, 0.0])) @ up, np.array([1, 1, 0]) / np.sqrt(2)
    )
