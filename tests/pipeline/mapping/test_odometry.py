"""RGB-D odometry: pairwise alignment, loop closure and gravity."""

import numpy as np
import pytest
import trimesh

from pipeline.geometry import rigid
from pipeline.geometry.ground import fit_ground
from pipeline.geometry.meshes import Mesh, RayCaster, render_view
from pipeline.mapping.icp import align_views, depth_image
from pipeline.mapping.odometry import (
    Guess,
    RelativePose,
    align_gravity,
    chain_alignments,
    correct_drift,
    optimize_pose_graph,
)

SIZE = (64, 48)
INTRINSICS = np.array([[48.0, 0, 24], [0, 48.0, 32], [0, 0, 1]])


@pytest.fixture(scope="module")
def room() -> RayCaster:
    """A 4 m room with boxes of several sizes, +y up, floor at 0."""
    walls = trimesh.creation.box((4, 2.4, 3.4))
    walls.invert()
    walls.apply_translation((0, 1.2, 0))
    parts = [walls]
    for size, at in [
        ((0.6, 0.5, 0.9), (1.2, 0.8)),
        ((0.4, 1.1, 0.4), (-1.3, -0.9)),
        ((0.8, 0.35, 0.5), (-0.9, 1.0)),
    ]:
        parts.append(trimesh.creation.box(size, rigid.make(np.eye(3), np.array([at[0], size[1] / 2, at[1]]))))
    mesh = trimesh.util.concatenate(parts)
    return RayCaster(Mesh(np.asarray(mesh.vertices, np.float32), np.asarray(mesh.faces)))


@pytest.fixture(scope="module")
def circle(room):
    """True poses on a circle around the center, and noisy depth views."""
    rng = np.random.default_rng(0)
    angles = np.linspace(0, 2 * np.pi * 1.05, 60)
    eyes = np.stack([1.1 * np.cos(angles), 1.0 + 0.1 * np.sin(3 * angles), 1.0 * np.sin(angles)], axis=1)
    poses = np.stack(
        [rigid.look_at(eye, np.array([0.1, 0.2, 0.0]), np.array([0.0, 1.0, 0.0])) for eye in eyes]
    )
    views = []
    for pose in poses:
        depth, _ = render_view(room, pose, INTRINSICS, *SIZE)
        depth = (depth + rng.normal(0, 0.004, depth.shape)).astype(np.float32)
        views.append(depth_image(depth, INTRINSICS, depth > 0, 1))
    return poses, views


def drifted(poses, rng, radians=0.002, meters=0.004):
    """Accumulate small random errors like odometry."""
    relative = rigid.inverse(poses[:-1]) @ poses[1:]
    steps = relative @ rigid.exp(
        np.c_[rng.normal(0, radians, (len(relative), 3)), rng.normal(0, meters, (len(relative), 3))]
    )
    return rigid.accumulate(steps, poses[0])


def test_alignment_recovers_a_small_motion(circle):
    poses, views = circle
    truth = rigid.inverse(poses[0]) @ poses[3]
    start = rigid.exp(np.array([0.02, -0.015, 0.01, 0.03, -0.02, 0.03])) @ truth
    found = align_views(views[0], views[3], start, reach_m=0.2, iterations=15)
    error = rigid.log(found.target_from_source @ rigid.inverse(truth))
    assert np.degrees(np.linalg.norm(error[:3])) < 0.4, "started 1.5 deg off"
    assert np.linalg.norm(error[3:]) < 0.008, "started 4.7 cm off; the depth noise is 4 mm"
    assert found.overlap > 0.5


def test_pose_graph_distributes_the_loop_closure_error():
    rng = np.random.default_rng(1)
    poses = np.stack(
        [rigid.exp(np.array([0, 2 * np.pi * i / 20, 0, np.sin(i / 3), 0, np.cos(i / 3)])) for i in range(20)]
    )
    odometry = drifted(poses, rng, 0.01, 0.02)
    relative = rigid.inverse(odometry[:-1]) @ odometry[1:]
    edges = [RelativePose(i, i + 1, relative[i], np.diag([1e4] * 3 + [2.5e3] * 3)) for i in range(19)]
    edges += [RelativePose(0, j, rigid.inverse(poses[0]) @ poses[j], np.eye(6) * 1e6) for j in (7, 13, 19)]
    found = optimize_pose_graph(odometry, edges, iterations=15)
    before = np.linalg.norm(odometry[:, :3, 3] - poses[:, :3, 3], axis=1)
    after = np.linalg.norm(found[:, :3, 3] - poses[:, :3, 3], axis=1)
    assert after[[7, 13, 19]].max() < 2e-3
    assert np.median(after) < 0.6 * np.median(before)


def test_pose_graph_is_robust_to_a_false_edge():
    poses = np.stack([rigid.exp(np.array([0, 0.1 * i, 0, 0.1 * i, 0, 0])) for i in range(15)])
    relative = rigid.inverse(poses[:-1]) @ poses[1:]
    edges = [RelativePose(i, i + 1, relative[i], np.diag([1e5] * 6), robust=False) for i in range(14)]
    wrong = rigid.exp(np.array([0, 0, 0.5, 1.0, 0, 0]))
    found = optimize_pose_graph(poses, [*edges, RelativePose(2, 12, wrong, np.eye(6) * 1e4)], iterations=20)
    assert np.abs(found[:, :3, 3] - poses[:, :3, 3]).max() < 0.02


def test_drift_is_corrected(circle):
    poses, views = circle
    odometry = drifted(poses, np.random.default_rng(2))
    found = correct_drift(views.__getitem__, 0.1 * np.arange(len(poses)), odometry)
    before = np.linalg.norm(odometry[:, :3, 3] - poses[:, :3, 3], axis=1)
    after = np.linalg.norm(found.world_from_camera[:, :3, 3] - poses[:, :3, 3], axis=1)
    assert np.median(after) < 0.6 * np.median(before)
    assert np.median(after) < 0.015, "meters; the depth noise is 4 mm, the odometry drifts by several cm"
    assert found.edges >= 12


def test_tracking_jump_is_repaired(circle):
    poses, views = circle
    odometry = drifted(poses, np.random.default_rng(2))
    odometry[35:] = rigid.exp(np.array([0, 0.1, 0, 0.5, 0, 0.3])) @ odometry[35:]
    found = correct_drift(views.__getitem__, 0.1 * np.arange(len(poses)), odometry)
    assert np.linalg.norm(found.world_from_camera[:, :3, 3] - poses[:, :3, 3], axis=1).max() < 0.05, (
        "meters; the jump is 0.6 m"
    )


def test_chained_alignment_needs_no_odometry(circle):
    poses, views = circle
    rng, relative = np.random.default_rng(4), rigid.inverse(poses[:-1]) @ poses[1:]
    guesses = relative @ rigid.exp(rng.normal(0, [0.02] * 3 + [0.03] * 3, (len(relative), 6)))
    found = chain_alignments(views.__getitem__, lambda frame, last: Guess(guesses[frame]), 12)
    guessed = np.stack([np.linalg.multi_dot([np.eye(4), np.eye(4), *guesses[:frame]]) for frame in range(12)])
    truth = rigid.inverse(poses[0]) @ poses[:12]
    error = np.linalg.norm(found[:, :3, 3] - truth[:, :3, 3], axis=1).max()
    assert error < 0.75 * np.linalg.norm(guessed[:, :3, 3] - truth[:, :3, 3], axis=1).max()
    assert error < 0.12, "meters over a walk of 1.2 m along plain walls"


def test_refuted_alignments_are_not_used(circle):
    poses, views = circle
    relative = rigid.inverse(poses[:-1]) @ poses[1:]
    found = chain_alignments(views.__getitem__, lambda frame, _: Guess(relative[frame], lambda _: False), 5)
    np.testing.assert_allclose(found, rigid.inverse(poses[0]) @ poses[:5], atol=1e-9)


def test_gravity_is_estimated(circle):
    poses, views = circle
    tilted = rigid.exp(np.array([0.25, 0.1, -0.2, 0, 0, 0])) @ poses
    up = (
        align_gravity(views.__getitem__, tilted)[:, :3, :3]
        @ np.swapaxes(poses[:, :3, :3], -1, -2)
        @ np.array([0.0, 1.0, 0.0])
    )
    assert np.degrees(np.arccos(np.clip(up[:, 1], -1, 1))).max() < 1.0


def test_floor_is_the_plane_below_the_focus():
    rng = np.random.default_rng(3)
    floor = np.c_[rng.uniform(-1, 1, 4000), rng.normal(0, 0.004, 4000), rng.uniform(-1, 1, 4000)]
    seat = np.c_[rng.uniform(-0.3, 0.3, 2500), rng.normal(0.45, 0.004, 2500), rng.uniform(-0.3, 0.3, 2500)]
    on_seat = fit_ground(np.concatenate([floor, seat]), np.array([0, 0.6, 0]), reach_m=0.3)
    assert abs(on_seat.above(np.array([0.1, 0.45, 0.1]))) < 0.003
    on_floor = fit_ground(np.concatenate([floor, seat]), np.array([0.7, 0.2, 0.7]), reach_m=0.3)
    assert abs(on_floor.above(np.array([0.7, 0.0, 0.7]))) < 0.003
