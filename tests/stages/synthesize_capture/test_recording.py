"""Rendered recordings are valid Record3D containers that agree with their ground truth, and are
deterministic.
"""

import json
import zipfile
from dataclasses import replace

import cv2
import lzfse
import numpy as np
import pytest

from pipeline.geometry import cameras, rigid
from stages.synthesize_capture import animal, film, produce, room, script
from stages.synthesize_capture.config import Config

CREATURE = animal.grow(np.random.default_rng(0), cell_m=0.016)
CONFIG = Config(
    seed=4,
    session_count=2,
    session_s=0.8,
    test_session_s=1.2,
    walkthrough_s=0.5,
    turnaround_s=0.5,
    heldout_of=1,
    dim_session=0,
    sideways_session=2,
)
PHONE = script.PhoneFormat(15.0, (160, 120), (128, 96))


@pytest.fixture(scope="module")
def scripts():
    return script.scripts(CONFIG, room.furnish(np.random.default_rng(4)), PHONE)


@pytest.fixture(scope="module")
def made(scripts, tmp_path_factory):
    folder = tmp_path_factory.mktemp("made")
    produce.produce(scripts, CREATURE, folder, folder, workers=1)
    return folder


@pytest.mark.slow
def test_bytes_are_independent_of_the_order(scripts, made, tmp_path):
    produce.record(scripts[2], CREATURE, tmp_path, tmp_path)
    for path in tmp_path.iterdir():
        assert path.read_bytes() == (made / path.name).read_bytes(), path.name


def test_container_follows_the_format(scripts, made):
    with zipfile.ZipFile(made / "session-1.r3d") as archive:
        about = json.loads(archive.read("metadata"))
        depth = np.frombuffer(lzfse.decompress(archive.read("rgbd/0.depth")), "<f4").reshape(
            about["dh"], about["dw"]
        )
        confidence = np.frombuffer(lzfse.decompress(archive.read("rgbd/0.conf")), np.uint8)
        color = cv2.imdecode(np.frombuffer(archive.read("rgbd/0.jpg"), np.uint8), cv2.IMREAD_COLOR)
    assert color.shape == (about["h"], about["w"], 3)
    assert about["h"] > about["w"]
    assert set(np.unique(confidence)) <= {0, 1, 2}
    assert 0.2 < np.nanmedian(depth) < 5
    assert about["K"][0] == pytest.approx(about["perFrameIntrinsicCoeffs"][0][0], abs=1e-3)
    assert len(about["poses"]) == len(about["frameTimestamps"]) == len(scripts[2].timestamp_s)
    assert about["frameTimestamps"][0] == 0
    x, y, z, w = about["poses"][3][:4]
    up = cameras.opencv_from_opengl(
        rigid.make(rigid.rotation_from_quaternion(np.array([w, x, y, z])), np.array(about["poses"][3][4:]))
    )
    np.testing.assert_allclose(up, scripts[2].odometry_from_camera[3], atol=1e-6)


def test_truth_is_upright_and_the_animal_fills_its_mask(scripts, made):
    for name in ("session-1", "session-2"):
        truth = np.load(made / f"{name}.npz")
        packed = np.load(made / f"{name}.masks.npz")
        masks = np.unpackbits(packed["packed"], axis=-1, count=packed["shape"][2]).astype(bool)
        assert (truth["world_from_camera"][:, 1, 1] < -0.3).all(), "the picture's y axis points down"
        frame = int(np.argmax(masks.mean((1, 2))))
        points = truth["agent_vertices_world"][frame].astype(float) + truth["world_from_agent"][frame, :3, 3]
        pixel, depth = cameras.project(
            rigid.apply(rigid.inverse(truth["world_from_camera"][frame]), points), truth["intrinsics"][frame]
        )
        height, width = masks.shape[1:]
        inside = (depth > 0) & (pixel >= 0).all(-1) & (pixel < [width, height]).all(-1)
        at = pixel[inside].astype(int)
        grown = cv2.dilate(masks[frame].astype(np.uint8), np.ones((3, 3), np.uint8))
        assert grown[at[:, 1], at[:, 0]].mean() > 0.6, (
            "most of its surface falls into its mask, the rest is hidden"
        )


def test_true_flow_agrees_with_depth(scripts):
    stage = film.Stage(scripts[2], CREATURE)
    flow = film.true_flow(stage, 0, 2)
    known = np.isfinite(flow[..., 0])
    assert known.mean() > 0.5
    assert np.nanmax(np.abs(film.true_flow(stage, 1, 1))) < 1e-2, "no time, no flow"


@pytest.mark.slow
def test_session_in_another_home_does_not_change_others(scripts, made, tmp_path):
    more = script.scripts(replace(CONFIG, foreign_sessions=1), room.furnish(np.random.default_rng(4)), PHONE)
    assert [part.name for part in more] == [*(part.name for part in scripts), "session-3"]
    elsewhere = more[-1]
    here = np.array([(s.x, s.z) for s in scripts[0].room.standing])
    assert len(elsewhere.room.standing) != len(here) or not np.allclose(
        [(s.x, s.z) for s in elsewhere.room.standing], here, atol=0.3
    )
    produce.produce(more[2:], CREATURE, tmp_path, tmp_path, workers=1)
    for name in ("session-1.r3d", "session-2.r3d"):
        assert (tmp_path / name).read_bytes() == (made / name).read_bytes()
    assert (tmp_path / "session-3.r3d").exists()
