"""DAISY features: invariance to light and resolution, equivariance to shifts, and storage of the basis."""

import cv2
import numpy as np
import pytest

from pipeline.backends.daisy import FeatureBasis, describe, fit_basis


def texture(height, width, seed=0):
    """Random RGB picture with structure at several scales."""
    rng = np.random.default_rng(seed)
    parts = [
        cv2.resize(rng.normal(size=(height // s, width // s)), (width, height), interpolation=cv2.INTER_CUBIC)
        * s
        for s in (4, 8, 16)
    ]
    total = sum(parts)
    gray = (40 + 170 * (total - total.min()) / np.ptp(total)).astype(np.uint8)
    return np.stack([gray, gray // 2, 255 - gray // 3], axis=-1)


@pytest.fixture(scope="module")
def basis():
    raw = [describe(texture(160, 120, seed), 8).reshape(-1, 104) for seed in range(6)]
    return fit_basis(np.concatenate(raw), whitening=0.5)


def test_features_have_unit_length_on_the_grid(basis):
    features = basis.project(describe(texture(163, 121), 8))
    assert features.shape == (20, 15, 16)
    np.testing.assert_allclose(np.linalg.norm(features, axis=-1), 1, atol=1e-5)


def test_features_are_invariant_to_light(basis):
    picture = texture(160, 120, 9)
    dim = np.clip(0.5 * picture + 10, 0, 255).astype(np.uint8)
    similarity = (basis.project(describe(picture, 8)) * basis.project(describe(dim, 8))).sum(-1)
    assert np.median(similarity) > 0.99


def test_features_shift_with_the_picture(basis):
    picture = texture(192, 144, 9)
    first, second = (
        basis.project(describe(part, 8)) for part in (picture[:160, :120], picture[16:176, 8:128])
    )
    similarity = (first[5:, 4:-3] * second[3:-2, 3:-4]).sum(-1)
    assert np.median(similarity) > 0.95


def test_nearest_neighbors_survive_blur_and_light_changes(basis):
    picture = texture(192, 144, 9)
    changed = cv2.convertScaleAbs(cv2.GaussianBlur(picture, (3, 3), 0), alpha=0.7, beta=20)
    first, second = (basis.project(describe(part, 8)).reshape(-1, 16) for part in (picture, changed))
    assert (np.argmax(first @ second.T, axis=1) == np.arange(len(first))).mean() > 0.8


def test_features_are_invariant_to_resolution(basis):
    picture = texture(320, 240, 4)
    big = cv2.resize(picture, None, fx=3, fy=3, interpolation=cv2.INTER_CUBIC)
    similarity = (basis.project(describe(picture, 8)) * basis.project(describe(big, 24))).sum(-1)
    assert np.median(similarity) > 0.98


def test_flat_pictures_give_zero_and_no_nan(basis):
    raw = describe(np.full((64, 48, 3), 90, np.uint8), 8)
    assert not raw.any()
    assert np.isfinite(basis.project(raw)).all()


def test_basis_survives_saving(basis, tmp_path):
    basis.save(tmp_path)
    raw = describe(texture(160, 120, 3), 8)
    assert np.array_equal(FeatureBasis.load(tmp_path).project(raw), basis.project(raw))


def test_full_whitening_gives_unit_covariance():
    rng = np.random.default_rng(0)
    raw = rng.normal(size=(5000, 20)) * np.linspace(5, 0.1, 20) + 3
    basis = fit_basis(raw.astype(np.float32), whitening=1.0)
    np.testing.assert_allclose(
        np.cov((raw - basis.mean) @ basis.components.T, rowvar=False), np.eye(16), atol=1e-3
    )
    assert np.all(np.diff(basis.explained) <= 0)
