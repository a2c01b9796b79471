"""Importers interpret the poses of real recordings consistently with depth."""

import dataclasses
import json
import os
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from pipeline.calibration import recordings as calibration
from pipeline.core.errors import InputError
from pipeline.geometry import cameras, rigid
from pipeline.recordings import conventions, extraction, stray_scanner, upright
from pipeline.recordings.formats import format_of, open_recording
from pipeline.recordings.recording import pose_from_matrix

REAL = Path(os.environ.get("ATS_REALDATA", Path(__file__).parents[3] / "shared" / "realdata"))
LIMIT_M = 0.015
"""the documented convention of the app agrees with real LiDAR depth within 15 mm"""


def _sample(name: str) -> Path:
    if not (REAL / name).exists():
        pytest.skip(f"no real recordings at {REAL} (set ATS_REALDATA)")
    return REAL / name


def test_exr_pictures_are_paired_with_their_rows():
    recording = open_recording(_sample("record3d_exr12"))
    metadata = json.loads((_sample("record3d_exr12") / "EXR_RGBD" / "metadata.json").read_text())
    assert len(metadata["poses"]) == 345
    assert recording.index.tolist() == [0, 30, 59, *range(90, 331, 30)]
    for row, number in enumerate(recording.index):
        np.testing.assert_array_equal(recording.pose[row], metadata["poses"][number])
        assert recording.timestamp_s[row] == metadata["frameTimestamps"][number]


@pytest.mark.slow
def test_seven_scenes_pass_the_pose_check():
    path = _sample("7scenes_AB50")
    assert format_of(path).name == "7-Scenes RGB-D"
    recording = open_recording(path)
    plan = extraction.understand(recording, rate_hz=10.0, max_depth_m=6.0, max_side_px=640)
    assert len(plan.chosen) == 50
    assert plan.pose_check.verdict == "documented"
    assert (
        plan.pose_check.residual_m < 2 * LIMIT_M
    )  # a Kinect v1, whose poses are accurate to some centimeters
    assert not plan.gravity_known


@pytest.mark.slow
@pytest.mark.parametrize("turn", range(1, 4))
def test_rotated_seven_scenes_are_detected(turn):
    recording = open_recording(_sample("7scenes_AB50"))
    turned = cameras.turn_camera(conventions.odometry_from_pose(recording.pose, conventions.OPENCV), turn)
    recording = dataclasses.replace(recording, pose=pose_from_matrix(turned))
    plan = extraction.understand(recording, rate_hz=10.0, max_depth_m=6.0, max_side_px=640)
    assert plan.pose_check.convention.quarter_turns == turn


@pytest.mark.slow
def test_kinect_pictures_brought_to_the_depth_cameras_lens_are_recognized(tmp_path):
    """Raw folders and copies with rescaled pictures state the same lens."""
    raw = open_recording(_sample("7scenes_AB50"))
    assert raw.depth_camera is not None and raw.intrinsics[0, 0, 0] == 525.5
    shutil.copytree(_sample("7scenes_AB50"), tmp_path / "copy")
    zoom = 585 / 525.5
    matrix = np.array([[zoom, 0, (1 - zoom) * 320], [0, zoom, (1 - zoom) * 240]])
    for path in (tmp_path / "copy").glob("*.color.jpg"):
        cv2.imwrite(str(path), cv2.warpAffine(cv2.imread(str(path)), matrix, (640, 480)))
    copy = open_recording(tmp_path / "copy")
    assert copy.depth_camera is None and copy.intrinsics[0, 0, 0] == 585
    found = calibration.calibrate(copy)
    assert found.used == ("camera",), "depth was not registered"
    assert found.estimate.focal == pytest.approx(1, abs=0.005)
    x, y = rigid.inverse(found.estimate.depth_from_color)[:2, 3]
    assert x == pytest.approx(-0.025, abs=0.006) and abs(y) < 0.006
    assert calibration.calibrate(raw).clear == ()


def test_stray_odometry_is_read():
    folder = _sample("stray_odometry")
    rows = stray_scanner.read_odometry((folder / "odometry_rows.csv").read_text(), "odometry_rows.csv")
    assert rows.frame.tolist() == [0, 1, 2, 3, 4, 5, 1641, 1642, 1643, 1714]
    np.testing.assert_allclose(np.linalg.norm(rows.pose[:, :4], axis=1), 1, atol=1e-6)
    assert rows.coefficients[6, 0] == 1604.2147
    odometry = conventions.odometry_from_pose(rows.pose, conventions.OPENCV)
    turned = np.degrees(rigid.rotation_angle(odometry[6, :3, :3], odometry[7, :3, :3]))
    assert abs(turned - 4.07) < 0.02  # although the sign of the quaternion flips between the two
    assert odometry[0, 1, 0] < -0.8  # held upright: the right side of the stored picture points down
    assert upright.quarter_turns_from_gravity(odometry[:6]) == 1


def test_exr_export_passes_the_pose_check():
    recording = open_recording(_sample("record3d_exr12"))
    plan = extraction.understand(recording, rate_hz=10.0, max_depth_m=6.0, max_side_px=640)
    assert plan.pose_check.verdict == "documented"
    assert plan.pose_check.residual_m < LIMIT_M
    assert plan.gravity_known
    assert plan.quarter_turns == 0
    frames = list(extraction.frames(recording, plan, max_depth_m=6.0))
    assert len(frames) == 12
    assert frames[0].color.shape == (640, 480, 3)
    np.testing.assert_allclose(plan.intrinsics[0], np.diag([1 / 3, 1 / 3, 1]) @ recording.intrinsics[0])
    assert min(frame.depth_valid for frame in frames) > 0.9


def test_archive_of_the_2022_app_is_read_without_pictures():
    with pytest.raises(InputError, match="CAP-006"):
        open_recording(_sample("record3d_r3d_metadata") / "data.r3d")


@pytest.mark.parametrize("turn", range(1, 4))
def test_rotated_poses_are_rejected_by_real_depth(turn):
    recording = open_recording(_sample("record3d_exr12"))
    wrong = conventions.odometry_from_pose(recording.pose, conventions.Convention(quarter_turns=turn))
    wxyz = rigid.quaternion_from_rotation(cameras.opencv_from_opengl(wrong)[:, :3, :3])
    pose = np.concatenate([np.roll(wxyz, -1, axis=1), wrong[:, :3, 3]], axis=1)
    size = recording.depth_size
    intrinsics = cameras.scale_intrinsics(recording.intrinsics, recording.color_size, size)

    def view(frame):
        return conventions.DepthPicture(recording.read_depth(int(recording.index[frame])), intrinsics[frame])

    check = conventions.check_poses(pose, recording.timestamp_s, view)
    assert check.verdict == "other"
    assert check.convention == conventions.Convention(quarter_turns=4 - turn)
