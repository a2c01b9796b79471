"""Simulated sensor errors have their specified magnitude."""

import numpy as np

from pipeline.geometry import rigid
from stages.synthesize_capture import sensor


def test_lidar_noise_reach_and_confidence():
    truth = np.full((256, 192), 3.0, np.float32)
    truth[:, 96:] = 1.5
    truth[:40] = 5.5
    depth, confidence = sensor.lidar(truth, np.random.default_rng(0))
    assert np.isnan(depth[:36]).all(), "nothing past 5 m"
    assert (confidence[:36] == 0).all()
    plain = depth[60:, 10:80] - 3.0
    assert 0.004 < plain.std() < 0.03
    assert abs(plain.mean()) < 0.004
    assert confidence[60:, 10:80].min() == 2
    assert confidence[60:, 95:97].max() == 0


def test_odometry_is_gravity_aligned_with_small_drift():
    times = np.arange(900) / 15
    angle = 0.3 * times
    position = np.stack([np.sin(angle), 1.4 + 0.1 * np.sin(times), np.cos(angle)], axis=-1)
    world_from_camera = rigid.make(
        rigid.rotation_from_vector(np.stack([0 * angle, angle, 0 * angle], -1)), position
    )
    for seed in range(4):
        odometry = sensor.odometry(np.random.default_rng(seed), times, world_from_camera)
        relative = rigid.rotation_angle(
            odometry[0, :3, :3].T @ odometry[-1, :3, :3],
            world_from_camera[0, :3, :3].T @ world_from_camera[-1, :3, :3],
        )
        assert np.rad2deg(relative) < 4.0, "a minute"
        up = odometry[:, :3, :3] @ np.swapaxes(world_from_camera[:, :3, :3], -1, -2) @ np.array([0, 1.0, 0])
        assert up[:, 1].min() > np.cos(np.deg2rad(1.0))
        length = np.linalg.norm(np.diff(odometry[::15, :3, 3], axis=0), axis=-1).sum()
        assert abs(length / np.linalg.norm(np.diff(position[::15], axis=0), axis=-1).sum() - 1) < 0.03


def test_timestamps_start_at_zero_and_have_gaps():
    times = sensor.timestamps(np.random.default_rng(1), 60.0, 15.0)
    step = np.diff(times)
    assert times[0] == 0
    assert (step > 0.05).all()
    assert step.max() > 0.12
    assert abs(times[-1] - 60) < 0.01
