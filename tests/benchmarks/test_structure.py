"""The reference of structure from motion is brought to our world by one similarity."""

import numpy as np

from benchmarks import structure
from pipeline.geometry import rigid


def cameras(rng: np.random.Generator, count: int = 12) -> np.ndarray:
    return rigid.make(rigid.rotation_from_vector(rng.normal(size=(count, 3))), rng.normal(size=(count, 3)))


def test_a_similarity_is_undone_for_frames_that_it_was_not_fitted_to():
    rng = np.random.default_rng(0)
    ours = cameras(rng)
    reference = cameras(rng, 1)[0] @ ours
    reference[:, :3, 3] *= 0.17
    found = structure.in_world(ours[:8], reference[:8], reference)
    np.testing.assert_allclose(found, ours, atol=1e-9)


def test_unregistered_frames_do_not_count():
    rng = np.random.default_rng(1)
    ours = cameras(rng)
    reference = ours.copy()
    reference[:, :3, 3] *= 3
    ours[2] = np.nan
    assert np.isclose(structure.scaled(ours, reference), 1 / 3)
