"""A real kitchen from color alone: camera path, intrinsics and depth compared with a depth camera."""

from dataclasses import dataclass

import cv2
import numpy as np
import pycolmap
import pytest

from pipeline.data.clips import Clip
from pipeline.geometry import cameras
from pipeline.recordings import extraction, upright
from pipeline.recordings.formats import open_recording
from stages.extract_frames import photogrammetry, writing
from stages.extract_frames.config import Config
from tests.pipeline.recordings import made_formats
from tests.real.seven_scenes import SCENE, Half, halves

COLOR_FOCAL_PX = (515.0, 565.0)
"""of the color camera, by the README of the sample closer to 525-555 than to the 585 of the depth camera"""


@dataclass(frozen=True)
class Walk:
    """The first half as a plain video, with the measured depth and cameras."""

    clip: Clip
    truth: Half
    kept: np.ndarray
    scale: float
    """meters per unit, from the camera centers"""
    gap_m: np.ndarray
    """distance of each camera from the truth after the similarity"""


@pytest.fixture(scope="module")
def walk(tmp_path_factory) -> Walk:
    folder = tmp_path_factory.mktemp("kitchen")
    truth, _ = halves(folder)
    made_formats.write_movie(
        folder / "walk.mp4", [truth.clip.color(i) for i in range(len(truth.clip))], rate=2
    )
    recording = open_recording(folder / "walk.mp4")
    cv2.setNumThreads(1)
    workspace = tmp_path_factory.mktemp("workspace")
    plan, frames, _ = photogrammetry.map_pictures(recording, {}, Config(), workspace)
    out = tmp_path_factory.mktemp("frames")
    written = writing.write_frames(out, frames, Config(), total=len(plan.chosen), where="walk")
    writing.write_table(out, recording, plan, written)
    clip, kept = Clip.open(out), plan.chosen[written.usable]
    centers, true = clip.odometry_from_camera[:, :3, 3], truth.world_from_camera[kept][:, :3, 3]
    fitted = pycolmap.estimate_sim3d(centers, true)
    moved = fitted.scale * centers @ fitted.rotation.matrix().T + fitted.translation
    return Walk(clip, truth, kept, float(fitted.scale), np.linalg.norm(moved - true, axis=1))


@pytest.mark.slow
def test_path_and_intrinsics_are_estimated(walk: Walk):
    assert len(walk.clip) >= 22
    assert np.sqrt((walk.gap_m**2).mean()) <= 0.08
    assert COLOR_FOCAL_PX[0] < walk.clip.intrinsics[0, 0, 0] < COLOR_FOCAL_PX[1]
    assert walk.clip.scale == extraction.RELATIVE


def test_depth_agrees_with_the_depth_camera(walk: Walk):
    ratio, covered = [], []
    for frame, row in enumerate(walk.kept):
        depth = walk.clip.depth(frame) * walk.scale
        rays = cameras.ray_directions(walk.clip.depth_intrinsics[frame], *depth.shape)
        pixel, _ = cameras.project(rays, walk.truth.clip.depth_intrinsics[row])
        column, line = np.moveaxis(np.clip(np.floor(pixel).astype(int), 0, (639, 479)), -1, 0)
        measured = walk.truth.clip.depth(int(row))[line, column]
        both = (depth > 0) & (measured > 0)
        ratio.append(depth[both] / measured[both])
        covered.append(both.sum() / (measured > 0).sum())
    off = np.abs(np.concatenate(ratio) - 1)
    assert np.median(off) <= 0.08, (
        "scale by 25 cameras of half a walk included; 0.062 measured, 0.021 over the whole walk"
    )
    assert np.mean(covered) >= 0.5


@pytest.mark.slow
@pytest.mark.parametrize("turns", range(4))
def test_sideways_video_is_rotated_upright(turns):
    """Without gravity, the room and the orientation of the camera determine the up direction."""
    if not SCENE.exists():
        pytest.skip(f"no real kitchen at {SCENE} (set ATS_REALDATA)")
    recording = open_recording(SCENE)
    plan = extraction.understand(recording, rate_hz=10.0, max_depth_m=6.0, max_side_px=640)
    assert plan.quarter_turns == 0
    stored = cameras.turn_camera(plan.odometry_from_camera, turns)
    views = []
    for row in np.linspace(0, len(plan.chosen) - 1, 12).round().astype(int):
        depth = extraction.stored_depth(recording, int(recording.index[plan.chosen[row]]), 6.0)
        views.append(
            (
                cameras.turn_image(depth, turns),
                cameras.turn_intrinsics(plan.depth_intrinsics[row], depth.shape, turns),
            )
        )
    assert upright.quarter_turns_from_room(stored, views) == -turns % 4
    up, gravity = upright.up_from_room(stored, views), np.loadtxt(SCENE / "gravity-direction.txt")
    assert np.degrees(np.arccos(np.clip(up @ -gravity, -1, 1))) < 3.0
