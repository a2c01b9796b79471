"""Pose optimization: correspondences recover displaced cameras, odometry constrains the others."""

import dataclasses

import numpy as np
import pytest

from pipeline.geometry import rigid
from pipeline.mapping import pose_optimization

FRAMES = 12


def corridor(rng):
    """Return true poses along a curve and points on three walls, whose planes constrain all six degrees of
    freedom.
    """
    time = np.linspace(0, 1, FRAMES)
    twist = np.stack(
        [
            0.2 * np.sin(3 * time),
            0.8 * time,
            0.1 * np.cos(4 * time),
            time,
            0.1 * time,
            0.3 * np.sin(2 * time),
        ],
        axis=-1,
    )
    points = rng.uniform(-2, 2, (300, 3))
    normals = np.eye(3)[np.arange(300) % 3]
    points[np.arange(300), np.arange(300) % 3] = 2.0
    return time, rigid.exp(twist), points, normals


def plane_correspondences(truth, points, normals, frames):
    """Return correspondences of all wall points with the map, as observed by the given frames."""
    first = np.repeat(frames, len(points))
    seen = np.concatenate([rigid.apply(rigid.inverse(truth[frame]), points) for frame in frames])
    tiled = np.tile(points, (len(frames), 1))
    count = len(first)
    return pose_optimization.Correspondences(
        first,
        np.full(count, pose_optimization.MAP),
        seen,
        tiled,
        np.tile(normals, (len(frames), 1)),
        np.full(count, 0.01),
    )


def test_correspondences_recover_displaced_cameras():
    rng = np.random.default_rng(0)
    _, truth, points, normals = corridor(rng)
    start = truth @ rigid.exp(rng.normal(0, 0.05, (FRAMES, 6)))
    correspondences = plane_correspondences(truth, points, normals, np.arange(FRAMES))
    found = pose_optimization.optimize_poses(start, lambda *_: correspondences, None, reach_m=(0.5,) * 6)
    assert np.abs(found.world_from_camera - truth).max() < 1e-5
    assert np.abs(found.residual_m).max() < 1e-5


def test_odometry_constrains_frames_without_correspondences():
    rng = np.random.default_rng(1)
    time, truth, points, normals = corridor(rng)
    moved = rigid.exp(np.array([0.1, -0.4, 0.2, 1.0, 2.0, 3.0])) @ truth
    edges = pose_optimization.odometry_factors(time, moved, drift_rad_s=0.01, drift_m_s=0.01)
    start = truth @ rigid.exp(rng.normal(0, 0.03, (FRAMES, 6)))
    correspondences = plane_correspondences(truth, points, normals, np.array([0]))
    found = pose_optimization.optimize_poses(start, lambda *_: correspondences, edges, reach_m=(0.5,) * 8)
    assert np.abs(found.world_from_camera - truth).max() < 1e-4


def test_covisible_pairs_are_aligned_and_fixed_frames_stay():
    rng = np.random.default_rng(2)
    _, truth, _, _ = corridor(rng)
    first, second = np.repeat(np.arange(FRAMES - 1), 60), np.repeat(np.arange(1, FRAMES), 60)
    world = rng.uniform(-2, 2, (len(first), 3))
    local = [
        np.einsum("cij,cj->ci", rigid.inverse(truth[index])[:, :3, :3], world)
        + rigid.inverse(truth[index])[:, :3, 3]
        for index in (first, second)
    ]
    correspondences = pose_optimization.Correspondences(
        first, second, *local, np.eye(3)[np.arange(len(first)) % 3], np.full(len(first), 0.01)
    )
    fixed = np.arange(FRAMES) == 0
    start = truth @ rigid.exp(rng.normal(0, 0.03, (FRAMES, 6)) * ~fixed[:, None])
    found = pose_optimization.optimize_poses(
        start, lambda *_: correspondences, None, reach_m=(0.5,) * 8, fixed=fixed
    )
    assert np.abs(found.world_from_camera - truth).max() < 1e-4
    assert (found.world_from_camera[0] == truth[0]).all()


def test_gross_outliers_are_rejected():
    rng = np.random.default_rng(3)
    _, truth, points, normals = corridor(rng)
    correspondences = plane_correspondences(truth, points, normals, np.arange(FRAMES))
    wrong = rng.random(len(correspondences.first)) < 0.2
    correspondences.points_second[wrong] += 1.0
    start = truth @ rigid.exp(rng.normal(0, 0.02, (FRAMES, 6)))
    found = pose_optimization.optimize_poses(
        start, lambda *_: correspondences, None, reach_m=(0.2,) * 4 + (0.05,) * 4
    )
    assert rigid.rotation_angle(found.world_from_camera[:, :3, :3], truth[:, :3, :3]).max() < np.deg2rad(0.3)


def test_marginal_covariance_is_correct_and_grows_away_from_correspondences():
    rng = np.random.default_rng(3)
    time, truth, points, normals = corridor(rng)
    correspondences = plane_correspondences(truth, points[:40], normals[:40], np.array([0, 1, 2]))
    edges = pose_optimization.odometry_factors(time, truth, drift_rad_s=0.05, drift_m_s=0.05)
    found = pose_optimization.marginal_covariance(truth, correspondences, edges, 0.5)
    normal, _ = pose_optimization._normal_equations(truth, correspondences, edges, 0.5)
    whole = np.linalg.inv(normal.toarray() + 1e-9 * np.eye(6 * FRAMES))
    dense = np.stack([whole[6 * frame : 6 * frame + 6, 6 * frame : 6 * frame + 6] for frame in range(FRAMES)])
    assert np.abs(found - dense).max() < 1e-6 * np.abs(dense).max()
    size = np.sqrt(found[:, range(3, 6), range(3, 6)].sum(1))
    assert (np.diff(size[2:]) > 0).all(), "meters: what odometry alone carries drifts"


def test_inconsistencies_are_in_standard_deviations():
    rng = np.random.default_rng(6)
    _, truth, points, normals = corridor(rng)
    exact = plane_correspondences(truth, points, normals, np.arange(FRAMES))
    squares = []
    for _ in range(20):
        error = rng.normal(0, 0.01, (len(exact.first), 3))
        noisy = dataclasses.replace(exact, points_first=exact.points_first + error)
        squares.append(pose_optimization.chi_squares(truth, noisy, exact.first, 1.0))
    factor = pose_optimization.variance_factor(np.concatenate(squares))
    assert 0.85 < factor < 1.15, "deviations are those assumed"
    assert pose_optimization.variance_factor(
        pose_optimization.chi_squares(truth, noisy.inflated(2.0), exact.first, 1.0)
    ) == pytest.approx(np.median(squares[-1]) / 4 / pose_optimization.MEDIAN_CHI_SQUARE, rel=1e-3)
