"""A plain video is placed as a whole: among wrong matches, not in two places, and from its pictures alone."""

import numpy as np
import pytest

from pipeline.core.videos import Video
from pipeline.data.clips import Clip, read_source_index
from pipeline.geometry import cameras, rigid
from pipeline.mapping.colmap import SparseModel
from stages.estimate_depth import lens as lenses
from stages.estimate_depth import sequence, stage
from stages.estimate_depth.config import Config
from stages.estimate_depth.landmarks import Matches
from stages.estimate_depth.lens import Lens
from tests.stages.estimate_depth import filmed_room

LENS = Lens(float(filmed_room.INTRINSICS[0, 0]), 0.0, filmed_room.SIZE)
SCALE, POINTS = 0.2, 60
BOUNDS = np.array([[-2.0, -0.2, -2.0], [2.0, 2.5, 2.0]])
MODEL_FROM_WORLD = rigid.exp(np.array([0.3, -1.0, 0.4, 5.0, -2.0, 1.0]))


def filmed(right: float, elsewhere: float):
    """Return path, model and matches: shares of right ones, and of those that fit 1.5 m beside."""
    rng, (path, _) = np.random.default_rng(0), filmed_room.session(12)
    points = np.stack(
        [rng.uniform(-1, 1, POINTS), rng.choice([0.0, 0.6], POINTS), rng.uniform(-1, 0.5, POINTS)], 1
    )
    scaled = rigid.make(MODEL_FROM_WORLD[:3, :3], MODEL_FROM_WORLD[:3, 3])
    key, point, pixel, matches = [], [], [], []
    for number, camera in enumerate(path):
        there, z = cameras.project(rigid.apply(rigid.inverse(camera), points), filmed_room.INTRINSICS)
        seen = np.flatnonzero(cameras.in_picture(there, z, filmed_room.SIZE, 0.1))
        key.append(np.full(len(seen), number))
        point.append(seen)
        pixel.append(there[seen])
        draw, world = rng.uniform(size=len(seen)), rng.uniform(BOUNDS[0], BOUNDS[1], (len(seen), 3))
        world[draw < right + elsewhere] = points[seen[draw < right + elsewhere]] + [1.5, 0, 0]
        world[draw < right] = points[seen[draw < right]]
        matches.append(Matches(there[seen] + rng.normal(0, 0.3, there[seen].shape), world))
    placed = scaled @ path
    placed[:, :3, 3] = SCALE * placed[:, :3, 3]
    model = SparseModel(
        np.arange(len(path)), placed, SCALE * rigid.apply(scaled, points), *map(np.concatenate, (point, key, pixel)),
        reprojection_px=0.3, reconstruction=None,
    )  # fmt: skip
    return path, model, matches


def test_a_few_right_matches_of_all_frames_place_the_video():
    path, model, matches = filmed(right=0.15, elsewhere=0.0)
    pairs = sequence.match_points(model, matches)
    found = sequence.align(model, pairs, LENS, BOUNDS, seed=0)
    assert found is not None
    placed = sequence.cameras_of(model, found)
    assert np.rad2deg(rigid.rotation_angle(placed[:, :3, :3], path[:, :3, :3])).max() < 1
    assert np.linalg.norm(placed[:, :3, 3] - path[:, :3, 3], axis=1).max() < 0.03


@pytest.mark.parametrize(("right", "elsewhere"), [(0.0, 0.0), (0.2, 0.2)])
def test_a_video_that_fits_nowhere_or_twice_has_no_place(right, elsewhere):
    _, model, matches = filmed(right, elsewhere)
    assert sequence.align(model, sequence.match_points(model, matches), LENS, BOUNDS, seed=0) is None


def test_a_video_without_matches_has_no_place():
    _, model, matches = filmed(0.5, 0.0)
    none = [Matches(np.zeros((0, 2)), np.zeros((0, 3))) for _ in matches]
    assert sequence.align(model, sequence.match_points(model, none), LENS, BOUNDS, seed=0) is None


@pytest.mark.slow
def test_session_is_placed_as_a_whole_where_no_frame_is_certain(tmp_path, monkeypatch):
    room, walk = filmed_room.room_and_walk()
    filmed_room.write_walk(tmp_path / "frames", room, walk)
    filmed_room.write_map(tmp_path / "map", room, walk)
    path, agent = filmed_room.session(24)
    filmed_room.write_pictures(tmp_path / "pictures", room, path, agent)
    monkeypatch.setattr(lenses, "calibrate", lambda *_: None)
    (tmp_path / "out").mkdir()
    inputs = stage.Inputs(tmp_path / "pictures", {"v000": tmp_path / "frames"}, tmp_path / "map")
    stage.run(inputs, Config(), tmp_path / "out", video=Video("v001", "a.mp4", "session", "none", None))
    clip, kept = Clip.open(tmp_path / "out"), read_source_index(tmp_path / "out")
    off_deg = np.rad2deg(rigid.rotation_angle(clip.odometry_from_camera[:, :3, :3], path[kept, :3, :3]))
    off_m = np.linalg.norm(clip.odometry_from_camera[:, :3, 3] - path[kept, :3, 3], axis=1)
    assert len(kept) >= 20 and np.median(off_deg) < 1.0 and np.median(off_m) < 0.04
