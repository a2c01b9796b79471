"""Support of the floor at all allowed positions, which are inside the home."""

import numpy as np

from pipeline.behavior.support import mark_supported
from stages.slice_behavior.floor import FILLED, SUPPORTED, with_filled_floor


def room(seen: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """A room of 20 x 20 voxels in a volume of 40 x 40 with a partly observed floor and a table."""
    rng = np.random.default_rng(seed)
    occupancy = np.full((40, 8, 40), 2, np.uint8)
    occupancy[10:30, 1:, 10:30] = 0
    occupancy[10:30, 0, 10:30] = np.where(rng.random((20, 20)) < seen, 1, 2)
    occupancy[14:18, 1:4, 14:18] = 1
    occupancy[33:38, 3:6, 33:38] = 0  # free space seen through a window
    return occupancy, mark_supported(occupancy == 0, occupancy)


def test_allowed_positions_have_support_inside_the_home():
    occupancy, marks = room(0.6)
    before = (marks > 0).any(1) & ~(marks == SUPPORTED).any(1)
    assert before.sum() > 100, "columns without a floor"
    visited = np.zeros(marks.shape, bool)
    visited[20, 2, 20] = True
    kept = with_filled_floor(marks, occupancy, visited)
    allowed = (kept > 0).any(1)
    assert not (allowed & ~(kept >= SUPPORTED).any(1)).any()
    assert not allowed[32:, 32:].any(), "beyond the window"
    assert (kept == FILLED).sum() >= 100 and set(np.argwhere(kept == FILLED)[:, 1]) == {1}
    assert (kept[15, :, 15] == marks[15, :, 15]).all(), "the table stays as it is"
    assert allowed[11:29, 11:29].all()


def test_complete_floor_is_unchanged():
    occupancy, marks = room(1.0)
    kept = with_filled_floor(marks, occupancy, np.zeros(marks.shape, bool))
    np.testing.assert_array_equal(kept[10:30, :, 10:30], marks[10:30, :, 10:30])


def test_no_floor_is_filled_without_support():
    marks = np.ones((4, 4, 4), np.uint8)
    np.testing.assert_array_equal(with_filled_floor(marks, np.zeros_like(marks), marks > 0), marks)
