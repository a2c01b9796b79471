"""Things that stay are not taken for an animal because poses drift."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

from pipeline.data.clips import Clip
from pipeline.data.flow import STRIDE_PX
from pipeline.geometry import cameras
from stages.segment_agent import free_space, locate, trajectory
from stages.segment_agent.config import AnimalConfig
from stages.segment_agent.free_space import DepthNoise, References

_spec = importlib.util.spec_from_file_location(
    "room_with_animal", Path(__file__).parent.parent / "room_with_animal.py"
)
scenery = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(scenery)

PINHOLE = np.array([[200.0, 0, 80], [0, 200.0, 60], [0, 0, 1]])
WALL_M, THING_M, SIDE_M = 2.0, 1.5, 0.15


def shown(center_m: float | None) -> np.ndarray:
    """Depth of a wall with a square thing in front of it, at a place along x."""
    depth = np.full((120, 160), WALL_M, np.float32)
    if center_m is not None:
        points = cameras.unproject(cameras.pixel_grid(120, 160), PINHOLE) * THING_M
        thing = (np.abs(points[..., 0] - center_m) < SIDE_M / 2) & (np.abs(points[..., 1]) < SIDE_M / 2)
        depth[thing] = THING_M
    return depth


def seen_from(pictures) -> tuple[References, np.ndarray]:
    """Return references that show the thing elsewhere, and the points of the thing itself."""
    depth, count = np.stack(pictures), len(pictures)
    poses, pinholes = np.repeat(np.eye(4)[None], count, 0), np.repeat(PINHOLE[None], count, 0)
    color = np.zeros((*depth.shape, 3), np.uint8)
    frames = 1 + np.arange(count)
    own = shown(0.0)
    points = cameras.back_project(own, PINHOLE)[own == THING_M]
    return References(poses, pinholes, depth, depth, color, frames, DepthNoise(0.002, 0.0025)), points


@pytest.mark.parametrize(
    ("others", "moved"),
    [
        ([None] * 4, True),
        ([0.06] * 8, False),
        ([-0.06] * 8, False),
        ([0.3] * 4, True),
        ([0.06] * 8 + [None] * 2, False),
        ([0.06] * 8 + [None] * 3, True),
    ],
    ids=["it left", "drift", "drift to the left", "it moved", "two witnesses", "three witnesses"],
)
def test_a_displaced_thing_does_not_move(others, moved):
    references, points = seen_from([shown(at) for at in others])
    assert free_space.vote(references, points, 0).free.sum() > 0, "votes alone see past it"
    assert free_space.seen_through(references, points, 0) == moved


def test_the_frame_itself_is_no_witness():
    references, points = seen_from([shown(None)] * 3)
    assert free_space.seen_through(references, points, 0)
    assert not free_space.seen_through(references, points, 2)


def test_nothing_is_tracked_in_an_empty_room_with_poor_poses(tmp_path):
    """The poses jump by 7 cm half-way, as where drift cannot be corrected."""
    poses, agent = scenery.session()
    wrong = poses.copy()
    wrong[20:] = scenery.rigid.exp(np.array([0, 0, 0, 0.05, 0.05, 0])) @ poses[20:]
    scenery.record(tmp_path, poses, np.full_like(agent, np.nan), poses)
    clip = Clip.open(tmp_path)
    references = free_space.gather(clip, wrong, 40)
    assert not any(locate.find_mover(clip, wrong, references, AnimalConfig(), None))


@pytest.mark.parametrize("off_m", [0.0, 0.05])
def test_drift_is_measured(tmp_path, off_m):
    """Poses of the second half are off, more than what is tolerated anyway."""
    poses, agent = scenery.session()
    scenery.record(tmp_path, poses, np.full_like(agent, np.nan), poses)
    wrong = poses.copy()
    wrong[20:] = scenery.rigid.exp(np.array([0, 0, 0, off_m, 0, 0])) @ poses[20:]
    drift_m = free_space.gather(Clip.open(tmp_path), wrong, 40).drift_m
    assert abs(drift_m - free_space.LATERAL_ERROR_M - off_m) < 0.02


def test_drift_is_assumed_where_nothing_overlaps(tmp_path):
    poses, agent = scenery.session()
    scenery.record(tmp_path, poses[:4], np.full_like(agent[:4], np.nan), poses[:4])
    assert free_space.gather(Clip.open(tmp_path), poses[:4], 4).drift_m == free_space.DRIFT_M


def test_motion_that_flow_does_not_show_is_refuted(tmp_path):
    """As that of ICP, which follows an animal close to the camera."""
    poses, agent = scenery.session()
    scenery.record(tmp_path, poses, np.full_like(agent, np.nan), poses)
    clip, motion = Clip.open(tmp_path), scenery.rigid.inverse(poses[0]) @ poses[1]
    pixel = STRIDE_PX * cameras.pixel_grid(*(side // STRIDE_PX for side in clip.color_size))
    points = trajectory.back_project_pixels(clip, 0, pixel.reshape(-1, 2), clip.depth(0))
    there, _ = cameras.project(scenery.rigid.apply(scenery.rigid.inverse(motion), points), clip.intrinsics[1])
    flow = there.reshape(pixel.shape) - pixel
    sure, rng = np.full(flow.shape[:2], 255, np.uint8), np.random.default_rng(0)
    guess = trajectory.motion_from_flow(clip, 0, flow, sure, rng)
    assert np.linalg.norm(guess.first_from_second[:3, 3] - motion[:3, 3]) < 0.02
    assert guess.agrees(motion)
    other = motion @ scenery.rigid.exp(np.array([0, 0, 0, 0.08, 0, 0]))
    assert not guess.agrees(other)
    assert trajectory.motion_from_flow(clip, 0, flow, 0 * sure, rng).agrees(other), "flow is uncertain"
