from dataclasses import replace

import numpy as np
import pytest
import torch

from pipeline.behavior.path_encoding import (
    GOAL_LENGTH_POWER,
    PATH_CHANNELS_OF,
    path_from_velocity_channels,
    snapped_to_goal,
    velocity_channels_from_path,
    warped_path,
    with_powered_length,
)
from tests.pipeline.behavior.wandering import scaling


def stroll(seed=0, count=20):
    """Curved paths at 0.1 to 2 m/s with rests before and after."""
    rng = np.random.default_rng(seed)
    turn = rng.normal(0, 0.2, (count, 56)).cumsum(1)
    pace = rng.uniform(0.1, 2.0, (count, 1)) * ((np.arange(56) > 10) & (np.arange(56) < 40))
    velocity = np.stack([np.sin(turn) * pace, 0.05 * pace, np.cos(turn) * pace], axis=-1)
    start = rng.normal(0, 1, (count, 3))
    return start[:, None] + (velocity / 10).cumsum(1), start


def strides_of(path, start):
    return velocity_channels_from_path(torch.from_numpy(path), torch.from_numpy(start)).numpy()


def test_stride_encoding_is_inverted_and_marks_rest():
    path, start = stroll()
    strides = strides_of(path, start)
    np.testing.assert_allclose(path_from_velocity_channels(strides, start), path, atol=1e-6)
    assert (strides[:, 11:40, 3] == 1).all() and (strides[:, :11, 3] == -1).all()


def test_residual_noise_does_not_move_a_resting_animal():
    path, start = stroll()
    noisy = strides_of(path, start) + 0.05 * np.random.default_rng(1).standard_normal((20, 56, 4))
    speed = np.linalg.norm(np.diff(path_from_velocity_channels(noisy, start), axis=1), axis=-1) * 10
    assert np.median(speed[:, 42:]) < 0.005 and speed[:, 42:].max() < 0.05
    places = path + 0.1 * np.random.default_rng(1).standard_normal(path.shape)
    assert np.median(np.linalg.norm(np.diff(places, axis=1), axis=-1) * 10) > 1


def test_warped_path_reaches_its_goal_and_keeps_rests():
    path, start = stroll()
    goal = path[:, -1] + np.random.default_rng(2).normal(0, 0.05, (20, 3))
    there = snapped_to_goal(path, start, goal, 1.0)
    reached = np.linalg.norm(path[:, -1] - start, axis=-1) > 0.3
    np.testing.assert_allclose(there[reached, -1], goal[reached], atol=1e-9)
    np.testing.assert_allclose(np.diff(there[:, 41:], axis=1), 0, atol=1e-9)
    np.testing.assert_array_equal(snapped_to_goal(path, start, goal, 0.0), path)
    asleep = np.repeat(start[:, None], 56, axis=1)
    np.testing.assert_array_equal(snapped_to_goal(asleep, start, goal, 1.0), asleep)
    far = snapped_to_goal(path, start, goal + 100, 1.0)
    assert (
        np.linalg.norm(np.diff(far - path, axis=1), axis=-1)
        <= np.linalg.norm(np.diff(path, axis=1), axis=-1) + 1e-9
    ).all()


@pytest.mark.parametrize("encoding", ["strides", "positions"])
def test_scaled_goals_and_paths_are_inverted_in_both_encodings(encoding):
    (path, start), scale = stroll(), replace(scaling(), encoding=encoding)
    np.testing.assert_allclose(scale.goal(scale.scaled_goal(path[:, -1])), path[:, -1], atol=1e-5)
    moved = path + np.linspace(0, 0.2, 56)[:, None]
    scaled = np.zeros((20, PATH_CHANNELS_OF[encoding], 56), np.float32)
    for places in (path, moved):
        scaled = scale.warped_path(scaled, start, places)
        np.testing.assert_allclose(scale.path(scaled, start), places, atol=1e-5)
    if encoding == "positions":
        np.testing.assert_allclose(scaled, scale.scaled_path(moved))
        np.testing.assert_allclose(scale.scaled_goal(path[:, -1]) * scale.goal_std, path[:, -1], atol=1e-5)


def test_strides_follow_a_warped_path():
    path, start = stroll()
    strides, moved = strides_of(path, start), path + np.linspace(0, 0.2, 56)[:, None]
    np.testing.assert_allclose(
        path_from_velocity_channels(warped_path(strides, start, moved), start), moved, atol=1e-6
    )


@pytest.mark.parametrize("power", [0.5, GOAL_LENGTH_POWER])
def test_velocity_power_is_inverted(power):
    way = np.random.default_rng(0).standard_normal((50, 3))
    np.testing.assert_allclose(
        with_powered_length(with_powered_length(way, power), 1 / power), way, atol=1e-9
    )
    assert np.isfinite(with_powered_length(np.zeros((1, 3)), power)).all()
