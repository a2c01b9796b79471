import numpy as np

from stages.estimate_depth import depth


def test_scale_and_shift_are_robust_to_moved_objects():
    rng = np.random.default_rng(0)
    true = rng.uniform(0.8, 4.0, (60, 80))
    inverse = (1 / true - 0.05) / 0.7
    mapped, counts = true.copy(), np.ones(true.shape, bool)
    mapped[:12] += 0.8  # a fifth of the room has changed
    counts[30:40, 30:50] = False
    found = depth.aligned(inverse, mapped, counts)
    assert np.median(np.abs(found[30:40, 30:50] - true[30:40, 30:50])) < 0.02


def test_small_overlap_and_inverted_predictions_are_refused():
    true = np.linspace(1, 3, 400).reshape(20, 20)
    few = np.zeros(true.shape, bool)
    few[0] = True
    assert not depth.aligned(1 / true, true, few).any()
    assert not depth.aligned(true, true, np.ones(true.shape, bool)).any()
