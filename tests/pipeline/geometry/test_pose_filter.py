import numpy as np

from pipeline.geometry import rigid

FRAMES, WINDOW = 400, 7
REST = slice(200, FRAMES)


def gait_and_rest() -> tuple[np.ndarray, np.ndarray]:
    """Return true and noisy poses of two bones that swing at 2 Hz (sampled at 10 Hz), then rest."""
    when, rng = np.arange(FRAMES) / 10, np.random.default_rng(0)
    twist = np.zeros((FRAMES, 2, 6))
    twist[:200, :, 0] = 0.4 * np.sin(4 * np.pi * when[:200, None] + np.array([0.0, np.pi]))
    twist[:200, :, 5] = 0.05 * np.sin(4 * np.pi * when[:200, None])
    noise = rng.normal(size=twist.shape) * np.repeat([0.03, 0.005], 3)
    return rigid.exp(twist), rigid.exp(twist) @ rigid.exp(noise)


def error(poses: np.ndarray, truth: np.ndarray, frames: slice) -> tuple[float, float]:
    angle = rigid.rotation_angle(poses[frames, :, :3, :3], truth[frames, :, :3, :3])
    shift = np.linalg.norm(poses[frames, :, :3, 3] - truth[frames, :, :3, 3], axis=-1)
    return float(angle.mean()), float(shift.mean())


def test_noise_is_reduced_at_rest_and_gait_is_preserved():
    truth, noisy = gait_and_rest()
    filtered = rigid.wiener_filter(noisy, np.ones(FRAMES, bool), WINDOW)
    before, after = error(noisy, truth, REST), error(filtered, truth, REST)
    assert after[0] < 0.7 * before[0] and after[1] < 0.7 * before[1]
    walking = slice(10, 190)
    before, after = error(noisy, truth, walking), error(filtered, truth, walking)
    assert after[0] < 1.02 * before[0] and after[1] < 1.02 * before[1]
    np.testing.assert_allclose(np.linalg.det(filtered[..., :3, :3]), 1, atol=1e-9)


def test_constant_poses_and_short_sequences_are_unchanged():
    still = np.repeat(rigid.exp(np.array([[0.1, 0.2, 0.3, 1.0, 2.0, 3.0]])), 20, axis=0)
    np.testing.assert_allclose(rigid.wiener_filter(still, np.ones(20, bool), WINDOW), still, atol=1e-9)
    noisy = gait_and_rest()[1][:5]
    assert rigid.wiener_filter(noisy, np.ones(5, bool), WINDOW) is noisy
