"""Sharpening of depth edges, and color evidence that tolerates misalignment."""

import numpy as np
import pytest

from stages.segment_agent.evidence import color_change
from stages.segment_agent.free_space import Votes
from stages.segment_agent.windows import Window, snap_depth_steps


@pytest.mark.parametrize(("share", "nearer"), [(0.4, 1.5), (0.6, 2.5)])
def test_flying_pixels_are_assigned_to_the_nearer_surface(share, nearer):
    step = np.where(np.arange(40) < 20, 1.5, 2.5)[None].repeat(30, 0).astype(np.float32)
    blurred, expected = step.copy(), step.copy()
    blurred[:, 20], expected[:, 20] = 1.5 + share, nearer
    np.testing.assert_array_equal(snap_depth_steps(blurred), expected)


def test_slopes_and_unknown_depth_are_unchanged():
    slope = np.linspace(1, 2, 60)[None].repeat(30, 0).astype(np.float32)
    slope[10:14, 20:24] = 0
    np.testing.assert_array_equal(snap_depth_steps(slope), slope)


def test_colors_of_adjacent_pixels_are_tolerated():
    rng = np.random.default_rng(0)
    stripes = np.where(np.arange(60) // 6 % 2 == 0, 60, 200)[None, :, None].repeat(60, 0).repeat(3, 2)
    before = stripes + rng.normal(0, 2, stripes.shape)
    now = 0.8 * np.roll(stripes, 1, axis=1) + rng.normal(0, 2, stripes.shape)
    now[20:34, 20:34] = [160, 40, 30]
    votes = Votes(*(np.zeros((60, 60)) for _ in range(3)), before.astype(np.float32))
    whole = slice(0, 60)
    window = Window(
        whole, whole, np.clip(now, 0, 255).astype(np.uint8), np.zeros((60, 60, 3)), np.ones((60, 60), bool)
    )
    other = color_change(window, votes, np.ones((60, 60), bool))
    assert (other[23:31, 23:31] > 1).mean() > 0.9
    assert (other[:, 40:] > 1).mean() < 0.02
