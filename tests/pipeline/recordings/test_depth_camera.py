"""Reprojection of depth from a separate depth camera to the color camera, with edges and occlusions."""

import dataclasses

import numpy as np
import pytest

from pipeline.core.errors import InputError
from pipeline.geometry import cameras, rigid
from pipeline.geometry.meshes import RayCaster, render_view
from pipeline.recordings import extraction
from pipeline.recordings.formats import open_recording
from pipeline.recordings.recording import DepthCamera, reproject
from tests.pipeline.recordings import made_formats
from tests.stages import textured_room
from tests.stages.extract_frames.made_recordings import walk

COLOR, COLOR_SIZE = np.array([[210.0, 0, 160], [0, 210.0, 120], [0, 0, 1]]), (240, 320)
DEPTH, DEPTH_SIZE = np.array([[234.0, 0, 158], [0, 236.0, 122], [0, 0, 1]]), (240, 320)
DEPTH_FROM_COLOR = rigid.make(
    rigid.rotation_from_vector(np.array([0.0, 0.02, 0.0])), np.array([0.05, 0.0, 0.0])
)


@pytest.mark.parametrize("share", [1.0, 0.5], ids=["same size", "half the size"])
def test_reprojected_depth_equals_that_of_the_color_camera(share):
    mesh = textured_room.textured_room(edge_m=0.05)
    caster, place = RayCaster(mesh), textured_room.walk(20)[7]
    size = tuple(round(side * share) for side in DEPTH_SIZE)
    lens = cameras.scale_intrinsics(DEPTH, DEPTH_SIZE, size)
    measured, _ = render_view(caster, place @ rigid.inverse(DEPTH_FROM_COLOR), lens, *size)
    true, _ = render_view(caster, place, cameras.scale_intrinsics(COLOR, COLOR_SIZE, size), *size)
    camera = DepthCamera(lens, DEPTH_FROM_COLOR)
    found = reproject(measured, camera, COLOR, COLOR_SIZE)
    assert found.shape == true.shape
    known = (found > 0) & (true > 0)
    error = np.abs(found - true)[known]
    assert known.mean() > 0.75, "the depth camera sees less to all sides"
    assert np.median(error) < 0.01
    before = np.abs(measured - true)[known]
    assert (error > 0.1).mean() < 0.03 < (before > 0.1).mean() + 0.02


def test_occluded_surfaces_are_removed():
    """A post at 1 m occludes different strips of the wall in each camera: the nearer surface wins."""
    depth = np.full(DEPTH_SIZE, 3.0, np.float32)
    depth[:, 150:170] = 1.0
    camera = DepthCamera(COLOR, rigid.make(np.eye(3), np.array([0.05, 0.0, 0.0])))
    found = reproject(depth, camera, COLOR, COLOR_SIZE)
    shift = round(210 * 0.05)
    assert (found[120, 151 - shift : 169 - shift] == 1.0).all()
    assert found[120, 100] == 3.0
    shadow = found[120, 170 - shift : 170 - round(210 * 0.05 / 3)]
    assert (shadow == 0).all(), "the depth camera never saw it"


@pytest.mark.parametrize("shrunk", [1, 2])
def test_confidence_is_that_of_the_surface_that_is_seen(tmp_path, shrunk):
    """A post of high confidence before a wall of medium, whose upper left part has low confidence."""
    recording = open_recording(made_formats.stray(tmp_path / "a", walk(8)))
    depth, confidence = np.full(DEPTH_SIZE, 3.0, np.float32), np.ones(DEPTH_SIZE, np.uint8)
    depth[:, 150:170], confidence[:, 150:170], confidence[:60, :150] = 1.0, 2, 0
    depth[200:] = 0
    made = dataclasses.replace(
        recording,
        color_size=COLOR_SIZE,
        intrinsics=np.repeat(COLOR[None], len(recording.index), axis=0),
        read_depth=lambda _: depth,
        read_confidence=lambda _: confidence[::shrunk, ::shrunk],
        depth_camera=DepthCamera(COLOR, rigid.make(np.eye(3), np.array([0.05, 0.0, 0.0]))),
    )
    seen = extraction.stored_depth(made, 0, 6.0)
    found = extraction.confidence_of(made, 0, seen)
    assert found.dtype == np.uint8 and found.shape == seen.shape and (found[seen == 0] == 0).all()
    assert (found[seen == 1.0] == 2).all(), "where the post is, not where the depth camera saw it"
    assert (confidence[seen == 1.0] != 2).any(), "it moves"
    wall = seen == 3.0
    assert (found[70:][wall[70:]] == 1).all() and (found[:50, :130][wall[:50, :130]] == 0).all()


def test_sidecar_describes_the_depth_camera(tmp_path):
    made = walk(12)
    aligned = open_recording(made_formats.tum(tmp_path / "a", made))
    assert aligned.depth_camera is None
    folder = made_formats.tum(tmp_path / "b", made)
    (folder / "depth_intrinsics.txt").write_text("30 30 12 16")
    (folder / "depth_from_color.txt").write_text("1 0 0 0.03\n0 1 0 0\n0 0 1 0\n0 0 0 1\n")
    recording = open_recording(folder)
    assert recording.depth_camera.depth_from_color[0, 3] == 0.03
    assert any("30 mm from the color camera" in remark for remark in recording.remarks)
    plan = extraction.understand(recording, rate_hz=10.0, max_depth_m=6.0, max_side_px=640)
    frame = next(iter(extraction.frames(recording, plan, max_depth_m=6.0)))
    lens = plan.depth_intrinsics[0]
    np.testing.assert_allclose(
        lens, cameras.scale_intrinsics(made.intrinsics, recording.color_size, frame.depth.shape)
    )
    (folder / "depth_from_color.txt").write_text("2 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n")
    with pytest.raises(InputError, match="CAP-004"):
        open_recording(folder)
    for apart in ("30", "2.5"):
        (folder / "depth_from_color.txt").write_text(f"1 0 0 {apart}\n0 1 0 0\n0 0 1 0\n0 0 0 1\n")
        with pytest.raises(InputError, match=f"(?s)CAP-004.*{apart} m apart.*in meters"):
            open_recording(folder)
