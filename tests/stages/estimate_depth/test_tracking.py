"""Cameras without landmarks are tracked from neighbors, but not across many pictures that show nothing."""

import numpy as np
import pytest

from pipeline.geometry.meshes import RayCaster
from stages.estimate_depth import foreground, landmarks, tracking, views
from stages.estimate_depth import lens as lenses
from stages.estimate_depth.landmarks import Matches
from stages.estimate_depth.lens import Lens
from tests.stages.estimate_depth import filmed_room

COUNT, LOCATED = 24, 8
WALK_STRIDE = 5


@pytest.fixture(scope="module")
def filmed():
    """The room, views of the walk-through, and the path and pictures of a session."""
    room, walk = filmed_room.room_and_walk()
    caster, rng = RayCaster(room), np.random.default_rng(0)

    def picture(camera):
        return filmed_room.render(caster, camera, None, rng)[0]

    seen = [
        views.view_of(views.small_gray(picture(pose)), filmed_room.INTRINSICS, pose, caster)
        for pose in walk[::WALK_STRIDE]
    ]
    path = filmed_room.session(COUNT)[0]
    return tracking.MapViews(caster, seen), path, [picture(camera) for camera in path]


@pytest.mark.parametrize("covered", [1, 6])
def test_cameras_are_tracked_over_short_gaps_only(filmed, covered, monkeypatch):
    room, path, pictures = filmed
    hidden, flow = range(LOCATED, LOCATED + covered), views.flow_matches
    shown = [np.zeros_like(each) if frame in hidden else each for frame, each in enumerate(pictures)]

    def flow_of_pictures(target, source):
        seen = np.ptp(target.gray) > 0 and np.ptp(source.gray) > 0
        return flow(target, source) if seen else Matches(np.zeros((0, 2)), np.zeros((0, 3)))

    monkeypatch.setattr(views, "flow_matches", flow_of_pictures)
    lens = Lens(float(filmed_room.INTRINSICS[0, 0]), 0.0, filmed_room.SIZE)
    footage = tracking.TrackingInput(
        0.1 * np.arange(COUNT),
        [views.small_gray(each) for each in shown],
        [landmarks.describe(each) for each in shown],
        lens,
    )
    localized = np.where(np.arange(COUNT)[:, None, None] < LOCATED, path, np.nan)
    found = tracking.place(footage, localized, room, seed=0)
    placed = found.placed
    assert placed[:LOCATED].all() and not placed[hidden].any()
    beyond = slice(LOCATED + covered, COUNT)
    if covered < tracking.NEIGHBORS[-1]:
        assert placed[beyond].all()
        off_m = np.linalg.norm(found.world_from_camera[beyond, :3, 3] - path[beyond, :3, 3], axis=1)
        assert off_m.max() < 0.05
    else:
        assert not placed[beyond].any()


def test_wrong_focal_length_is_corrected(filmed):
    room, path, pictures = filmed
    true_px = float(filmed_room.INTRINSICS[0, 0])
    wrong = Lens(0.88 * true_px, 0.0, filmed_room.SIZE)
    footage = tracking.TrackingInput(
        0.1 * np.arange(COUNT),
        [views.small_gray(each) for each in pictures],
        [landmarks.describe(each) for each in pictures],
        wrong,
    )
    pixel = np.stack(np.meshgrid(np.arange(5, 180, 25.0), np.arange(5, 240, 25.0)), axis=-1).reshape(-1, 2)
    surface = [landmarks.on_surface(pixel, filmed_room.INTRINSICS, pose, room.caster) for pose in path]
    seen = [np.isfinite(each[:, 0]) for each in surface]
    matches = [Matches(pixel[hit], points[hit]) for hit, points in zip(seen, surface, strict=True)]
    localized = lenses.locate_all(matches, wrong, seed=0)
    assert np.nanmedian(np.linalg.norm(localized[:, :3, 3] - path[:, :3, 3], axis=1)) > 0.1
    found = tracking.place(footage, localized, room, seed=0)
    assert found.lens.focal_px == pytest.approx(true_px, rel=0.01)
    assert np.linalg.norm(found.world_from_camera[:, :3, 3] - path[:, :3, 3], axis=1).max() < 0.03


def test_nothing_is_in_front_where_no_picture_shows_the_same(filmed):
    room, path, pictures = filmed
    gray = views.small_gray(pictures[0])
    view = views.view_of(gray, filmed_room.INTRINSICS, path[0], room.caster)
    shown = foreground.color_view(pictures[0], view)
    assert not foreground.foreground(shown, [], []).any()
    for sources in (([shown], []), ([], [shown, shown])):
        assert not foreground.foreground(shown, *sources).any(), "it differs from none"
