"""Even subsampling."""

import numpy as np
import pytest

from pipeline.geometry import subsampling


@pytest.mark.parametrize(
    ("count", "most", "chosen"), [(10, 4, [0, 3, 6, 9]), (3, 8, [0, 1, 2]), (1, 5, [0]), (0, 5, [])]
)
def test_subsample_is_even_and_bounded(count, most, chosen):
    assert subsampling.evenly(count, most).tolist() == chosen


def test_some_items_are_all_where_they_are_few():
    few, many = np.arange(3, 60, 2), np.arange(7, 100_007)
    np.testing.assert_array_equal(subsampling.some(few, 8192), few)
    chosen = subsampling.some(many, 8192)
    assert len(chosen) == 8192 and (chosen[0], chosen[-1]) == (7, 100_006)
    assert set(np.diff(chosen)) == {12, 13}
    assert len(subsampling.some(few[:0], 5)) == 0


@pytest.mark.parametrize(
    ("good", "found"), [([1, 1, 0, 1, 0, 0], [[0, 2], [3, 4]]), ([0, 1], [[1, 2]]), ([0, 0], []), ([], [])]
)
def test_runs_are_maximal_and_end_before_their_end(good, found):
    assert subsampling.runs(np.array(good, bool)).tolist() == found
