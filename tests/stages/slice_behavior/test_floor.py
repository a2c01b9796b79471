"""Support of the floor at all allowed positions, which are inside the home."""

import numpy as np
import pytest

from pipeline.behavior.perception import FeatureVolume
from pipeline.behavior.support import mark_supported, with_headroom
from pipeline.behavior.trajectories import Trajectory
from pipeline.data import npz
from pipeline.geometry import rigid
from stages.slice_behavior.floor import FILLED, SUPPORTED, with_filled_floor, with_level_floor
from stages.slice_behavior.windows import write_volumes


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


@pytest.mark.parametrize("seen", [0.8, 0.4, 0.1])
def test_heights_above_filled_floor_are_those_above_seen_floor(tmp_path, seen):
    ranges = []
    for share in (1.0, seen):
        occupancy, _ = room(share)
        volume = FeatureVolume(np.zeros((1, *occupancy.shape), np.float16), occupancy, np.zeros(3), 0.1)
        place = np.stack([np.linspace(1.1, 2.9, 60), np.full(60, 0.25), np.full(60, 2.2)], axis=-1)
        poses = rigid.make(np.broadcast_to(np.eye(3), (60, 3, 3)), place)
        track = Trajectory(np.arange(60) / 10, poses, poses[:, None], poses, np.ones(60, bool))
        folder = tmp_path / f"{share}"
        folder.mkdir()
        write_volumes(folder, (volume,), {"v000": track}, ("v000",), 10)
        ranges.append(npz.load(folder / "volume.npz")["stands_m"])
    np.testing.assert_allclose(ranges[1], ranges[0], atol=1e-6)


@pytest.mark.parametrize("raised", [0.0, 0.1])
def test_floor_is_level_unless_recordings_show_that_it_is_not(raised):
    """Half of the floor seems a voxel higher: noise, or something that carries the animal higher."""
    occupancy, _ = room(1.0)
    volume = FeatureVolume(np.zeros((1, *occupancy.shape), np.float16), occupancy, np.zeros(3), 0.1)
    occupancy[20:30, 1, 10:30] = 1
    marks = mark_supported(occupancy == 0, occupancy)
    place = np.stack([np.linspace(1.1, 2.9, 60), np.full(60, 0.31), np.full(60, 2.2)], axis=-1)
    place[place[:, 0] > 2.0, 1] += raised
    level = with_level_floor(marks, volume, place)
    assert (level > 0).sum() >= (marks > 0).sum(), "nothing is forbidden"
    assert len(np.unique((level == SUPPORTED)[10:30, :, 20].argmax(1))) == (1 if raised == 0 else 2)


def test_supports_are_where_the_body_fits():
    _, marks = room(1.0)
    marks[11:13, 3:5, 11:20] = 0  # nobody saw the space above this floor
    stands_m = np.array([[0.21, 0.28], [0.25, 0.3]])
    kept = with_headroom(marks, 0.1, stands_m)
    assert not kept[11:13, :, 11:20].any()
    marks[11:13, :, 11:20] = 0
    np.testing.assert_array_equal(kept[10:30, :, 10:30], marks[10:30, :, 10:30])
    np.testing.assert_array_equal(with_headroom(marks, 0.1, np.full((2, 2), np.nan)), marks)


def test_home_is_the_floor_where_the_animal_was():
    occupancy = np.full((40, 8, 20), 2, np.uint8)
    occupancy[:, 1:] = 0
    occupancy[2:22, 0, 2:18] = occupancy[32:38, 0, 2:18] = 1
    marks, visited = mark_supported(occupancy == 0, occupancy), np.zeros(occupancy.shape, bool)
    for column, own, other in ((35, 35, 10), (10, 10, 35)):
        visited[:] = False
        visited[column, 2, 10] = True
        home = (with_filled_floor(marks, occupancy, visited) > 0).any(1)
        assert home[own, 10] and not home[other, 10]
