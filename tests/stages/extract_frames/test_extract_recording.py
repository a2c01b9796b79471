"""Extracted frames agree with the ground truth for any orientation of the phone."""

import sys

import numpy as np
import pytest
import trimesh

from pipeline.data import images, npz, ply
from pipeline.data.clips import Clip
from pipeline.geometry import cameras, rigid
from pipeline.workflow import cli
from stages.extract_frames import __main__ as front
from stages.extract_frames import stage
from stages.extract_frames.config import Config
from tests.pipeline.recordings import made_formats
from tests.stages.extract_frames.made_recordings import COLOR_SIZE, DEPTH_SIZE, walk


def _extract(recording, out, monkeypatch, *options):
    monkeypatch.setattr(
        sys, "argv", ["extract_frames", "--recording", str(recording), "--out", str(out), *options]
    )
    cli.main(front.__doc__, stage.run, stage.Inputs, Config)
    return Clip.open(out)


@pytest.mark.parametrize("turns", range(4))
def test_frames_are_upright_and_agree_with_the_truth(tmp_path, monkeypatch, turns):
    made = walk(36, quarter_turns=turns)
    clip = _extract(made.write(tmp_path / "a.r3d"), tmp_path / "out", monkeypatch)
    source = npz.load(tmp_path / "out" / "frames.npz")["source_index"]
    assert len(clip) == 24
    np.testing.assert_allclose(clip.timestamp_s, made.timestamp_s[source])
    np.testing.assert_allclose(clip.odometry_from_camera, made.world_from_camera[source], atol=1e-6)
    np.testing.assert_allclose(clip.intrinsics[0], walk().intrinsics, atol=1e-9)
    assert clip.color_size == COLOR_SIZE
    assert clip.depth_size == DEPTH_SIZE
    assert np.array_equal(clip.confidence(0), np.ones(DEPTH_SIZE, np.uint8))
    upright = walk(36)
    np.testing.assert_allclose(clip.depth(5), upright.depth(source[5]), rtol=1e-3)
    assert np.abs(clip.color(5).astype(int) - upright.color(source[5])).mean() < 3
    np.testing.assert_allclose(
        clip.depth_intrinsics[0],
        cameras.scale_intrinsics(clip.intrinsics[0], COLOR_SIZE, DEPTH_SIZE),
        atol=1e-9,
    )


def test_color_bytes_are_copied_untouched_when_upright(tmp_path, monkeypatch):
    made = walk(12)
    clip = _extract(made.write(tmp_path / "a.r3d"), tmp_path / "out", monkeypatch)
    assert (clip.folder / "color" / "000000.jpg").read_bytes() == images.encode_jpeg(made.color(0))


def test_per_frame_intrinsics_are_preferred(tmp_path, monkeypatch):
    made = walk(12)
    made.metadata["perFrameIntrinsicCoeffs"] = [[50 + i, 52 + i, 25, 31] for i in range(12)]
    clip = _extract(made.write(tmp_path / "a.r3d"), tmp_path / "out", monkeypatch)
    source = npz.load(tmp_path / "out" / "frames.npz")["source_index"]
    np.testing.assert_allclose(clip.intrinsics[:, 0, 0], 50 + source)


def test_old_recordings_have_times_from_the_frame_rate_and_no_gravity(tmp_path, monkeypatch):
    made = walk(88)
    made.timestamp_s = np.arange(88) / 60
    first = made.world_from_camera[0] @ np.diag([1, -1, -1, 1])
    made.metadata |= dict(frameTimestamps=None, initPose=None)
    poses = rigid.inverse(first) @ made.world_from_camera @ np.diag([1, -1, -1, 1])
    wxyz = rigid.quaternion_from_rotation(poses[:, :3, :3])
    made.metadata["poses"] = np.concatenate([np.roll(wxyz, -1, 1), poses[:, :3, 3]], 1).tolist()
    clip = _extract(made.write(tmp_path / "a.r3d"), tmp_path / "out", monkeypatch)
    assert not clip.gravity_known
    np.testing.assert_allclose(np.diff(clip.timestamp_s), 0.1)


@pytest.mark.parametrize("pose", [[0, 0, 0, 0, 0, 0, 0], [0, 0, 0, 1, 0, 0, 0]], ids=["zero", "identity"])
def test_unusable_poses_are_dropped_and_reported(tmp_path, monkeypatch, pose):
    made = walk(24)
    made.metadata["poses"] = [pose] * 24
    clip = _extract(made.write(tmp_path / "a.r3d"), tmp_path / "out", monkeypatch)
    assert clip.odometry_from_camera is None
    assert '"status": "warn"' in (tmp_path / "out" / "qa.json").read_text()


def test_extraction_is_deterministic(tmp_path, monkeypatch):
    recording = walk(12, quarter_turns=1).write(tmp_path / "a.r3d")
    for out in ("one", "two"):
        _extract(recording, tmp_path / out, monkeypatch)
    files = [
        path.relative_to(tmp_path / "one") for path in sorted((tmp_path / "one").rglob("*")) if path.is_file()
    ]
    assert all(
        (tmp_path / "one" / name).read_bytes() == (tmp_path / "two" / name).read_bytes() for name in files
    )


@pytest.mark.parametrize("turns", [0, 1])
def test_large_pictures_are_reduced_with_their_intrinsics(tmp_path, monkeypatch, turns):
    made = walk(12, quarter_turns=turns)
    (tmp_path / "config.toml").write_text("max_side_px = 32")
    options = ("--config", str(tmp_path / "config.toml"))
    clip = _extract(made.write(tmp_path / "a.r3d"), tmp_path / "out", monkeypatch, *options)
    assert clip.color_size == (32, 24)
    np.testing.assert_allclose(clip.intrinsics[0], np.diag([0.5, 0.5, 1]) @ walk().intrinsics)
    np.testing.assert_allclose(clip.odometry_from_camera[0], made.world_from_camera[0], atol=1e-6)


def test_mesh_of_the_app_is_extracted(tmp_path, monkeypatch):
    folder = made_formats.polycam(tmp_path / "a", walk(24))
    made_formats.polycam_mesh(folder, trimesh.creation.box((4.0, 2.5, 5.0)), np.eye(4))
    clip = _extract(folder, tmp_path / "out", monkeypatch)
    assert np.allclose(np.ptp(ply.read_ply(clip.folder / "mesh.ply").vertices, axis=0), (4.0, 2.5, 5.0))
