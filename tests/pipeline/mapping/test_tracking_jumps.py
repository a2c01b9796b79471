"""Detection and repair of tracking jumps, without false alarms for fast motion, gaps and tilting."""

import numpy as np

from pipeline.geometry import rigid
from pipeline.geometry.meshes import RayCaster, render_view
from pipeline.mapping.icp import depth_image
from pipeline.mapping.odometry import find_jumps, repair
from tests.stages.textured_room import INTRINSICS, SIZE, aligned_errors, drifting, textured_room, walk

TIME_S = 0.1 * np.arange(60)


def jumping(odometry, frame, meters=0.6):
    """Insert a tracking jump before a frame: all later poses are displaced and rotated."""
    displaced = odometry.copy()
    displaced[frame:] = rigid.exp(np.array([0, 0.2, 0, meters, 0, 0])) @ odometry[frame:]
    return displaced


def test_jump_is_detected_and_repaired():
    truth = walk(60)
    odometry = jumping(jumping(drifting(truth, 4, deg=0.03, m=0.001), 20), 41, 0.9)
    jumps = find_jumps(TIME_S, odometry)
    assert np.flatnonzero(jumps).tolist() == [20, 41]
    assert aligned_errors(odometry, truth)[1].max() > 0.3, "meters"
    assert aligned_errors(repair(TIME_S, odometry, jumps), truth)[1].max() < 0.03, "meters, drift included"


def test_single_displaced_frame_gives_two_jumps():
    odometry = walk(60)
    odometry[30, :3, 3] += 1.0
    assert np.flatnonzero(find_jumps(TIME_S, odometry)).tolist() == [30, 31]


def test_hand_motion_is_no_jump():
    ends = np.array([0.0, 2.0, 2.5, 6.0])
    lunge = rigid.make(
        np.eye(3), np.interp(TIME_S, ends, [0.0, 1.0, 3.5, 5.0])[:, None] * np.array([1.0, 0, 0])
    )
    tipped = walk(60)
    tipped[30:, :3, :3] = tipped[30:, :3, :3] @ rigid.rotation_from_vector(np.array([0, 0, 3.0]))
    pause_s = TIME_S + 1.0 * (np.arange(60) >= 30)
    paused = rigid.make(np.eye(3), np.cumsum(np.diff(pause_s, prepend=0.0))[:, None] * np.array([1.0, 0, 0]))
    for time_s, odometry in (
        (TIME_S, lunge),
        (TIME_S, tipped),
        (pause_s, paused),
        (TIME_S[:1], tipped[:1]),
        (TIME_S[:2], lunge[:2]),
    ):
        jumps = find_jumps(time_s, odometry)
        assert not jumps.any()
        assert repair(time_s, odometry, jumps) is odometry


def test_depth_decides_ambiguous_motion():
    truth, caster = walk(60), RayCaster(textured_room(edge_m=0.5))

    def view(frame):
        depth, _ = render_view(caster, truth[frame], INTRINSICS, *SIZE)
        return depth_image(depth, INTRINSICS, depth > 0, 2)

    jumped = jumping(drifting(truth, 4, deg=0.03, m=0.001), 20, 0.25)
    assert not find_jumps(TIME_S, jumped).any(), "2.5 m/s: without depth it may be a hand"
    assert np.flatnonzero(find_jumps(TIME_S, jumped, view)).tolist() == [20]
    dash = truth.copy()
    dash[30:, :3, 3] += [0.0, 0.2, 0.0]
    truth = dash
    assert not find_jumps(TIME_S, dash, view).any(), "depth confirms that the phone moved"
