"""Even subsampling."""

import numpy as np
import pytest

from pipeline.geometry import subsampling


@pytest.mark.parametrize(
    ("count", "most", "chosen"), [(10, 4, [0, 3, 6, 9]), (3, 8, [0, 1, 2]), (1, 5, [0]), (0, 5, [])]
)
def test_subsample_is_even_and_bounded(count, most, chosen):
    assert subsampling.evenly(count, most).tolist() == chosen


@pytest.mark.parametrize(
    ("good", "found"), [([1, 1, 0, 1, 0, 0], [[0, 2], [3, 4]]), ([0, 1], [[1, 2]]), ([0, 0], []), ([], [])]
)
def test_runs_are_maximal_and_end_before_their_end(good, found):
    assert subsampling.runs(np.array(good, bool)).tolist() == found
