import numpy as np

from stages.estimate_depth import monocular


def test_the_map_gives_scale_and_shift_in_spite_of_moved_things():
    rng = np.random.default_rng(0)
    true = rng.uniform(0.8, 4.0, (60, 80))
    inverse = (1 / true - 0.05) / 0.7
    mapped, counts = true.copy(), np.ones(true.shape, bool)
    mapped[:12] += 0.8  # a fifth of the room has changed
    counts[30:40, 30:50] = False
    found = monocular.aligned(inverse, mapped, counts)
    assert np.median(np.abs(found[30:40, 30:50] - true[30:40, 30:50])) < 0.02


def test_nothing_is_told_where_little_of_the_map_is_seen_or_the_network_is_inside_out():
    true = np.linspace(1, 3, 400).reshape(20, 20)
    few = np.zeros(true.shape, bool)
    few[0] = True
    assert not monocular.aligned(1 / true, true, few).any()
    assert not monocular.aligned(true, true, np.ones(true.shape, bool)).any()
