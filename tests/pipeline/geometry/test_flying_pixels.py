"""Flying pixels are removed, thin structures are kept."""

import numpy as np

from pipeline.geometry.flying_pixels import supported


def test_two_pixel_limb_is_kept_and_flying_pixels_are_removed():
    depth = np.full((20, 24), 3.0)
    depth[:, 10:12] = 2.0
    depth[:, 9], depth[:, 12] = 2.4, 2.7
    depth[4, 4] = 0
    found = supported(depth)
    assert found[1:-1, 10:12].all()
    assert not found[:, [9, 12]].any()
    assert not found[4, 4]
    assert found[1:-1, 14:-1].all()
