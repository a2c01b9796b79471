"""Real Record3D recordings: the importer's reading of the poses agrees with the depth."""

import os
from pathlib import Path

import numpy as np
import pytest

from pipeline.errors import InputError
from pipeline.space import cameras, rigid
from stages.extract_frames import conventions, extraction
from stages.extract_frames.record3d import open_recording

REAL = Path(os.environ.get("ATS_REALDATA", Path(__file__).parents[3] / "shared" / "realdata"))
LIMIT_M = 0.015
"""the app's documented convention explains real LiDAR depth within 15 mm"""


def _sample(name: str) -> Path:
    if not (REAL / name).exists():
        pytest.skip(f"no real recordings at {REAL} (set ATS_REALDATA)")
    return REAL / name


def test_exr_export_passes_the_self_check():
    recording = open_recording(_sample("record3d_exr12"))
    plan = extraction.understand(recording, rate_hz=10.0, max_depth_m=6.0, pairs=6, max_side_px=640)
    assert plan.self_check.verdict == "documented"
    assert plan.self_check.residual_m < LIMIT_M
    assert plan.gravity_known
    assert plan.quarter_turns == 0
    frames = list(extraction.frames(recording, plan, max_depth_m=6.0, jpeg_quality=95))
    assert len(frames) == 12
    assert frames[0].color.shape == (640, 480, 3)
    np.testing.assert_allclose(plan.intrinsics[0], np.diag([1 / 3, 1 / 3, 1]) @ recording.intrinsics[0])
    assert min(frame.depth_valid for frame in frames) > 0.9


def test_archive_of_the_2022_app_is_understood_although_its_pictures_are_gone():
    with pytest.raises(InputError, match="CAP-006"):
        open_recording(_sample("record3d_r3d_metadata") / "data.r3d")


@pytest.mark.parametrize("turn", range(1, 4))
def test_turned_readings_are_refuted_by_real_depth(turn):
    recording = open_recording(_sample("record3d_exr12"))
    wrong = conventions.odometry_from_pose(recording.pose, conventions.Convention(quarter_turns=turn))
    wxyz = rigid.quaternion_from_rotation(cameras.opencv_from_opengl(wrong)[:, :3, :3])
    pose = np.concatenate([np.roll(wxyz, -1, axis=1), wrong[:, :3, 3]], axis=1)
    size = recording.depth_size
    intrinsics = cameras.scale_intrinsics(recording.intrinsics, recording.color_size, size)

    def view(frame):
        return conventions.DepthView(recording.read_depth(int(recording.index[frame])), intrinsics[frame])

    check = conventions.check_poses(pose, recording.timestamp_s, view)
    assert check.verdict == "other"
    assert check.convention == conventions.Convention(quarter_turns=4 - turn)
