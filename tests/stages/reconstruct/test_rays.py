"""Ray samples of pictures are at their positions."""

import numpy as np
import pytest

from stages.reconstruct.rays import (
    AGENT,
    FAR_PX,
    NOT_AGENT,
    THUMBNAIL,
    UNKNOWN,
    choose_agent_pixels,
    mask_distance_px,
    near_agent,
)


@pytest.mark.parametrize(("radius_px", "label"), [(9.0, AGENT), (25.0, AGENT), (25.0, UNKNOWN)])
def test_mask_distance_is_measured_at_pixel_centers(radius_px, label):
    height, width, center = 80, 120, np.array([53.0, 37.0])
    x, y = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    mask = np.where(np.hypot(x - center[0], y - center[1]) < radius_px, label, NOT_AGENT).astype(np.uint8)
    found = mask_distance_px(mask, (height // THUMBNAIL, width // THUMBNAIL)).astype(float)
    middle = np.stack(
        np.meshgrid(*((np.arange(size // THUMBNAIL) + 0.5) * THUMBNAIL for size in (width, height))), axis=-1
    )
    true = np.linalg.norm(middle - center, axis=-1) - radius_px
    assert np.abs(found - true)[true > -0.5 * radius_px].max() < 1.0, (
        "pixels are counted as in or out whole: below one pixel"
    )
    assert abs((found - true)[np.abs(true) < 6].mean()) < 0.1, "neither shifted nor eroded, pixels"


def test_mask_distance_without_mask_is_maximal():
    assert (mask_distance_px(np.zeros((8, 8), np.uint8), (2, 2)) == FAR_PX).all()


@pytest.mark.parametrize("count", [150, 4000])
def test_thin_limbs_are_sampled_as_much_as_the_trunk(count):
    mask = np.zeros((100, 100), np.uint8)
    mask[20:60, 20:60] = mask[60:90, 38:42] = AGENT  # a leg four pixels wide
    near = near_agent(mask, 5)
    row, column = choose_agent_pixels(mask, near, count, np.random.default_rng(0)).T
    assert len(set(zip(row, column, strict=True))) == len(row) == min(count, near.sum()), (
        "none twice, as many as there are"
    )
    assert near[row, column].all()
    on_mask = mask[row, column] == AGENT
    assert abs(on_mask.sum() - min(0.75 * count, (mask == AGENT).sum())) <= 1
    if count < on_mask.sum() + (mask == AGENT).sum():
        share = (row[on_mask] >= 60).mean()
        assert share > 2 * (mask[60:] == AGENT).sum() / (mask == AGENT).sum(), (
            "a leg's pixels count more than a trunk's"
        )
