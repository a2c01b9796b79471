"""Support of roots: the nearest surface within the recorded height range, with jumps between surfaces."""

import numpy as np
import pytest

from pipeline.behavior.perception import FeatureVolume
from pipeline.behavior.support import JUMP_KERNEL, Support, height_ranges, mark_supported, smoothed_jumps

VOXEL_M = 0.1
RANGE_M = np.array([[0.15, 0.25], [0.2, 0.25]])


def volume() -> FeatureVolume:
    """A floor at height 0 and, on half of it, a table top from 0.4 to 0.5."""
    occupancy = np.zeros((20, 15, 20), np.uint8)
    occupancy[:, :2] = 1
    occupancy[10:, 6] = 1
    return FeatureVolume(
        np.zeros((1, *occupancy.shape), np.float32), occupancy, np.array([0.0, -0.2, 0.0]), VOXEL_M
    )


@pytest.fixture
def support() -> Support:
    scene = volume()
    return Support.of(scene, mark_supported(scene.occupancy == 0, scene.occupancy), RANGE_M)


def test_support_lies_directly_above_solid_voxels():
    scene = volume()
    marks = mark_supported(scene.occupancy == 0, scene.occupancy)
    assert (marks[:, 2] == 2).all() and (marks[10:, 7] == 2).all()
    assert (marks == 2).sum() == 20 * 20 + 10 * 20
    assert (marks[scene.occupancy == 1] == 0).all()


def test_roots_move_to_the_nearest_surface(support):
    points = np.array(
        [
            [0.5, 0.4, 1.0],
            [0.5, 0.05, 1.0],
            [1.5, 0.3, 1.0],
            [1.5, 0.6, 1.0],
            [1.5, 1.2, 1.0],
            [0.5, 0.22, 1.0],
        ]
    )
    resting = support.heights(points, np.zeros(6, bool))
    np.testing.assert_allclose(resting, [0.25, 0.15, 0.25, 0.65, 0.75, 0.22])
    assert support.heights(points[1], np.array(True)) == pytest.approx(0.2), (
        "who moves stands higher than who lies"
    )


def test_support_is_unknown_outside_the_scene_and_without_surface(support):
    beyond = np.array([[-1.0, 0.7, 0.5], [5.0, 0.7, 0.5]])
    np.testing.assert_allclose(support.heights(beyond, np.zeros(2, bool)), 0.7)
    scene = volume()
    marks = mark_supported(scene.occupancy == 0, scene.occupancy)
    assert Support.of(scene, np.minimum(marks, 1), RANGE_M) is None
    assert Support.of(scene, marks, np.full((2, 2), np.nan)) is None


def test_height_range_is_that_of_recordings():
    rng = np.random.default_rng(0)
    points = rng.uniform([0.1, 0.15, 0.1], [0.9, 0.25, 1.9], (4000, 3))
    moves = rng.random(4000) < 0.5
    points[moves, 1] = 0.2
    scene = volume()
    here = scene, mark_supported(scene.occupancy == 0, scene.occupancy)
    found = height_ranges([(*here, points, moves)])
    np.testing.assert_allclose(found, [[0.15, 0.25], [0.2, 0.2]], atol=0.003)
    table = np.add(points, [1.0, 0.5, 0.0])
    np.testing.assert_allclose(height_ranges([(*here, table, moves)]), found, atol=1e-9)
    assert np.isnan(height_ranges([(*here, points - [5.0, 0.0, 0.0], moves)])).all()
    assert np.isnan(height_ranges([])).all()


def test_height_steps_become_jumps_that_clear_edges():
    height = np.r_[np.full(10, 0.7), np.full(10, 0.2)]
    jump = smoothed_jumps(height, np.array(0.7))
    assert (jump >= height).all()
    np.testing.assert_allclose(
        jump[[9, 10, 11, 12]], [0.7, 0.2 + 0.5 * JUMP_KERNEL[:2].sum(), 0.2 + 0.5 * JUMP_KERNEL[0], 0.2]
    )
    np.testing.assert_allclose(smoothed_jumps(height[::-1], np.array(0.2)), jump[::-1])
    np.testing.assert_allclose(smoothed_jumps(np.full(5, 0.3), np.array(0.3)), 0.3)
