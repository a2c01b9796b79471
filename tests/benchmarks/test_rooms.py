"""Splitting a 7-Scenes style folder into two recordings without poses."""

import cv2
import numpy as np
import pytest

from benchmarks.real import rooms
from pipeline.core.errors import InputError
from pipeline.geometry import rigid
from pipeline.metrics.pose_errors import PoseErrors

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


def _write_published(data, sequence, cameras):
    (data / rooms.PUBLISHED_FILES).mkdir(parents=True, exist_ok=True)
    camera_from_world = rigid.inverse(cameras)
    lines = [
        f"{sequence}/frame-{number:06d}.color.png {' '.join(f'{x:.9f}' for x in [*q, *t])} 525.505"
        for number, (q, t) in enumerate(
            zip(
                rigid.quaternion_from_rotation(camera_from_world[:, :3, :3]),
                camera_from_world[:, :3, 3],
                strict=True,
            )
        )
    ]
    with (data / rooms.PUBLISHED_FILES / "redkitchen_test.txt").open("a") as file:
        file.write("\n".join(lines) + "\n")


def test_published_cameras_are_those_of_the_sequence_that_the_folder_shows(tmp_path, capsys):
    rng = np.random.default_rng(0)
    shown, other = (
        rigid.make(rigid.rotation_from_vector(rng.normal(size=(20, 3))), rng.normal(size=(20, 3)))
        for _ in range(2)
    )
    known = dict(enumerate(shown))
    assert rooms.published_cameras(tmp_path, known) is None
    assert "no " in capsys.readouterr().err
    _write_published(tmp_path, "seq-03", other)
    assert rooms.published_cameras(tmp_path, known) is None
    elsewhere = other[0] @ shown
    elsewhere[:, :3, 3] *= 0.9
    _write_published(tmp_path, "seq-04", elsewhere)
    found = rooms.published_cameras(tmp_path, known)
    np.testing.assert_allclose(np.stack([found[number] for number in known]), elsewhere, atol=1e-6)
    with (tmp_path / rooms.PUBLISHED_FILES / "redkitchen_test.txt").open("a") as file:
        file.write("seq-04/frame-000020.color.png 1 0 0 0 1 2\n")
    with pytest.raises(InputError, match="TRJ-001"):
        rooms.published_cameras(tmp_path, known)


def test_bar_needs_all_frames_within_its_limits():
    errors = PoseErrors(np.full(20, 0.2), np.full(20, 0.006))
    assert rooms.is_met(rooms.summary(errors))
    errors.meters[3] = 0.06
    assert rooms.summary(errors)["close"] == 0.95
    assert not rooms.is_met(rooms.summary(errors))
