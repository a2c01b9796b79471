"""Videos without depth: camera path and intrinsics by COLMAP, depth from pictures, scale from other
recordings.
"""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from pipeline.calibration.given import NOTHING, GivenCalibration
from pipeline.core.errors import InputError
from pipeline.geometry import align, rigid
from pipeline.geometry.meshes import RayCaster, render_view
from pipeline.mapping import plane_sweep, sift
from pipeline.recordings.recording import Recording
from stages.extract_frames import photogrammetry, scaling, structure
from stages.extract_frames.config import Config, PhotogrammetryConfig
from tests.stages import textured_room

SIZE = (240, 180)
INTRINSICS = np.array([[178.0, 0, 90], [0, 178.0, 120], [0, 0, 1]])
CONFIG = PhotogrammetryConfig(
    features=700, overlap=4, retrieved=1, focal_share=0.8, depth_side_px=120, depth_planes=64, depth_sources=4
)


@pytest.fixture(scope="module")
def room():
    mesh = textured_room.textured_room(edge_m=0.03)
    return mesh, RayCaster(mesh)


def _seen(room, camera: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Color and z-depth from a camera."""
    mesh, caster = room
    depth, hits = render_view(caster, camera, INTRINSICS, *SIZE)
    return hits.interpolate(mesh, mesh.color).reshape(*SIZE, 3).astype(np.uint8), depth


def _recording(room, path: np.ndarray, *, with_depth: bool = False) -> Recording:
    pictures = [_seen(room, camera) for camera in path]
    return Recording(
        where="made",
        kind="rendered",
        index=np.arange(len(path)),
        timestamp_s=np.arange(len(path)) * 0.1,
        intrinsics=np.repeat(INTRINSICS[None], len(path), axis=0) if with_depth else None,
        pose=None,
        color_size=SIZE,
        depth_size=SIZE if with_depth else None,
        read_color=lambda i: pictures[i][0],
        read_depth=lambda i: pictures[i][1],
    )


def _mapped(recording: Recording, measured, folder: Path):
    return photogrammetry.map_pictures(recording, measured, Config(without_depth=CONFIG), folder)


@pytest.mark.slow
def test_walkthrough_is_mapped_and_scaled_by_a_session_with_depth(room, tmp_path):
    truth = textured_room.walk(14)
    session = _recording(
        room, textured_room.walk(14)[2:12:3] @ rigid.make(np.eye(3), np.array([0.03, 0, 0])), with_depth=True
    )
    plan, frames, _ = _mapped(_recording(room, truth), {"v002": (session, NOTHING)}, tmp_path)
    assert plan.scale == "v002"
    assert len(plan.chosen) >= 10
    assert abs(plan.intrinsics[0, 0, 0] / INTRINSICS[0, 0] - 1) < 0.04, "the focal length was not told"
    centers = truth[plan.chosen, :3, 3]
    moved = rigid.apply(
        align.kabsch(plan.odometry_from_camera[:, :3, 3], centers), plan.odometry_from_camera[:, :3, 3]
    )
    assert np.linalg.norm(moved - centers, axis=1).max() < 0.08, "meters, without any scale"
    off, known = [], []
    for frame, row in zip(frames, plan.chosen, strict=True):
        true = _seen(room, truth[row])[1][::2, ::2]
        seen = frame.depth > 0
        off.append(frame.depth[seen] / true[seen] - 1)
        known.append(seen.mean())
    assert np.median(np.abs(np.concatenate(off))) < 0.04
    assert np.mean(known) > 0.5


def test_scale_uses_the_depth_camera_that_is_given(room):
    """Depth of another lens, described in `<recording>.depth.toml`, puts points beside where they are."""
    path = textured_room.walk(30)[:20]
    lens = INTRINSICS * np.array([[0.85, 1, 1], [1, 0.85, 1], [1, 1, 1]])
    depth = [render_view(room[1], camera, lens, *SIZE)[0] for camera in path]
    session = replace(_recording(room, path, with_depth=True), read_depth=lambda i: depth[i])
    mapped = []
    for camera in path[3::4]:
        color, true = _seen(room, camera)
        described = sift.describe(cv2.cvtColor(color, cv2.COLOR_RGB2GRAY), scaling.POINTS)
        mapped.append(sift.lift(described, INTRINSICS, true, INTRINSICS))
    given = GivenCalibration(depth_intrinsics=tuple(lens[[0, 1, 0, 1], [0, 1, 2, 2]]))
    assert abs(scaling.meters_per_unit(mapped, (session, given), 0) - 1) < 0.01
    assert abs(scaling.meters_per_unit(mapped, (session, NOTHING), 0) - 1) > 0.03


def test_pure_rotation_is_refused(room, tmp_path):
    here = np.array([0.0, 1.3, 0.0])
    angles = np.linspace(0, 1.2, 12)
    spot = np.stack(
        [rigid.look_at(here, here + np.array([np.cos(a), -0.3, np.sin(a)]), textured_room.UP) for a in angles]
    )
    with pytest.raises(InputError, match="MAP-004"):
        _mapped(_recording(room, spot), {}, tmp_path)


def test_static_camera_is_refused(room, tmp_path):
    with pytest.raises(InputError, match="MAP-004"):
        _mapped(_recording(room, np.repeat(textured_room.walk(1), 12, axis=0)), {}, tmp_path)


def test_consistent_multi_view_depth_is_accurate(room):
    path = textured_room.walk(60)[10:19:3]
    pictures = [_seen(room, camera) for camera in path]
    views = [
        plane_sweep.SweepView(color.mean(-1).astype(np.float32), INTRINSICS, camera)
        for (color, _), camera in zip(pictures, path, strict=True)
    ]
    depth = [
        plane_sweep.sweep(views[i], [views[j] for j in range(3) if j != i], (0.5, 4.0), 48) for i in range(3)
    ]
    agree = plane_sweep.agreement(depth[1], views[1], [(depth[i], views[i]) for i in (0, 2)])
    off = np.abs(depth[1] / np.maximum(pictures[1][1], 1e-3) - 1)
    assert (agree == 2).mean() > 0.15
    assert np.median(off[agree == 2]) < 0.02
    assert (off[agree == 2] < 0.05).mean() > 0.9
    assert np.median(off[agree == 0]) > 2 * np.median(off[agree == 2]), "what is refused is worse"


def test_keyframes_are_selected_by_motion():
    config = PhotogrammetryConfig(keyframe_share=0.1, max_keyframes=20)
    traveled = np.concatenate([np.zeros(50), np.linspace(0, 1, 50)])
    sharpness = np.ones(100)
    sharpness[::7] = 2.0
    keys = structure.choose_keyframes(traveled, sharpness, config)
    assert 10 <= len(keys) <= 12
    assert (keys < 50).sum() == 1, "a phone that rests shows one place"
    assert (keys % 7 == 0).mean() > 0.6, "the sharpest of each step"
    assert len(structure.choose_keyframes(100 * traveled, sharpness, config)) <= 20
