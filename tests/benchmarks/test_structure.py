"""Alignment of structure from motion to our world by a similarity."""

import numpy as np

from benchmarks import structure
from pipeline.geometry import rigid


def cameras(rng: np.random.Generator, count: int = 12) -> np.ndarray:
    return rigid.make(rigid.rotation_from_vector(rng.normal(size=(count, 3))), rng.normal(size=(count, 3)))


def test_alignment_undoes_a_similarity_on_held_out_frames():
    rng = np.random.default_rng(0)
    ours = cameras(rng)
    reference = cameras(rng, 1)[0] @ ours
    reference[:, :3, 3] *= 0.17
    found = structure.in_world(ours[:8], reference[:8], reference)
    np.testing.assert_allclose(found, ours, atol=1e-9)


def test_scale_ignores_unregistered_frames():
    rng = np.random.default_rng(1)
    ours = cameras(rng)
    reference = ours.copy()
    reference[:, :3, 3] *= 3
    ours[2] = np.nan
    assert np.isclose(structure.scale_to(ours, reference), 1 / 3)
