"""Splitting a 7-Scenes style folder into two recordings without poses."""

import cv2
import numpy as np
import pytest

from benchmarks.real import rooms

FRAMES = tuple(range(0, 200, 20))


@pytest.mark.slow
def test_halves_have_pictures_and_true_cameras_but_no_odometry(tmp_path):
    scene, rng = tmp_path / "7scenes_synthetic", np.random.default_rng(0)
    scene.mkdir()
    np.savetxt(scene / "camera-intrinsics.txt", np.array([[585.0, 0, 320], [0, 585, 240], [0, 0, 1]]))
    poses = np.tile(np.eye(4), (len(FRAMES), 1, 1))
    poses[:, 0, 3] = np.arange(len(FRAMES))
    for number, pose in zip(FRAMES, poses, strict=True):
        base = scene / f"frame-{number:06d}"
        cv2.imwrite(f"{base}.color.jpg", rng.integers(0, 255, (480, 640, 3), np.uint8))
        cv2.imwrite(f"{base}.depth.png", np.full((480, 640), 2000, np.uint16))
        np.savetxt(f"{base}.pose.txt", pose)
    first, second = rooms.halves(scene, tmp_path / "out")
    assert len(first.clip) == len(second.clip) == len(FRAMES) // 2
    np.testing.assert_array_equal(second.world_from_camera, poses[len(FRAMES) // 2 :])
    assert first.clip.odometry_from_camera is None
    masks = rooms.empty_masks(first.clip, tmp_path / "masks")
    assert not masks.visible.any() and not masks[0].any()
