"""Depth of thin things is kept, what flies beside them is not."""

import numpy as np

from pipeline.geometry.flying_pixels import supported


def test_a_limb_two_pixels_wide_is_kept_and_the_pixels_flying_beside_it_are_not():
    depth = np.full((20, 24), 3.0)
    depth[:, 10:12] = 2.0
    depth[:, 9], depth[:, 12] = 2.4, 2.7
    depth[4, 4] = 0
    found = supported(depth)
    assert found[1:-1, 10:12].all()
    assert not found[:, [9, 12]].any()
    assert not found[4, 4]
    assert found[1:-1, 14:-1].all()
