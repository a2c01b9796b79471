"""Even subsampling."""

import pytest

from pipeline.geometry import subsampling


@pytest.mark.parametrize(
    ("count", "most", "chosen"), [(10, 4, [0, 3, 6, 9]), (3, 8, [0, 1, 2]), (1, 5, [0]), (0, 5, [])]
)
def test_subsample_is_even_and_bounded(count, most, chosen):
    assert subsampling.evenly(count, most).tolist() == chosen
