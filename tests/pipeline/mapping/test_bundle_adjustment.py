"""Bundle adjustment recovers cameras and scale, and estimates standard deviations from residuals."""

import numpy as np
import pytest
from scipy import sparse

from pipeline.geometry import cameras, rigid
from pipeline.mapping import pose_optimization
from pipeline.mapping.bundle_adjustment import PointTerm, TrackedPoints, build_tracks

CAMERAS, POINTS, FOCAL_PX = 6, 80, 300.0
NO_INDEX, NO_POINT = np.zeros(0, int), np.zeros((0, 3))
NOTHING = pose_optimization.Correspondences(NO_INDEX, NO_INDEX, NO_POINT, NO_POINT, NO_POINT, np.zeros(0))


def observed(rng, noise_px=0.0, depth_scale=1.0, noise_m=0.0):
    """Return cameras along a curve and their observations of a point cloud, some without depth."""
    twist = np.linspace(0, 1, CAMERAS)[:, None] * np.array([0.1, -0.3, 0.1, 1.2, 0.2, 0.3])
    truth, cloud = rigid.exp(twist), rng.uniform((-0.6, -1, 2.5), (1.4, 1, 4.5), (POINTS, 3))
    camera, point = (each.ravel() for each in np.meshgrid(np.arange(CAMERAS), np.arange(POINTS)))
    local = np.stack(
        [
            rigid.apply(rigid.inverse(truth[c]), cloud[p : p + 1])[0]
            for c, p in zip(camera, point, strict=True)
        ]
    )
    lens = np.array([[FOCAL_PX, 0, 160.0], [0, FOCAL_PX, 120.0], [0, 0, 1]])
    pixel = cameras.project(local, lens)[0] + rng.normal(0, noise_px, (len(camera), 2))
    depth = depth_scale * local[:, 2] + rng.normal(0, noise_m, len(camera))
    depth[rng.random(len(depth)) < 0.3] = np.nan
    rows = np.ones((len(camera), 1))
    tracked = TrackedPoints(
        camera,
        point,
        pixel,
        rows * FOCAL_PX * np.ones(2),
        rows * [160.0, 120.0],
        depth,
        np.full(len(camera), 0.02),
        np.zeros(len(camera), int),
    )
    return truth, tracked


def optimized(start, tracked, term=None):
    fixed, term = np.arange(CAMERAS) == 0, term or PointTerm(tracked, start)
    return pose_optimization.optimize_poses(
        start, lambda *_: NOTHING, None, reach_m=(1.0,) * 12, fixed=fixed, term=term
    ).world_from_camera


def displaced(truth, rng):
    error = rng.normal(0, 0.02, (CAMERAS, 6))
    error[0] = 0
    return truth @ rigid.exp(error)


def test_cameras_and_scale_are_recovered():
    rng = np.random.default_rng(0)
    truth, tracked = observed(rng)
    assert np.abs(optimized(displaced(truth, rng), tracked) - truth).max() < 1e-4


def test_outliers_of_matches_and_depth_are_rejected():
    rng = np.random.default_rng(1)
    truth, tracked = observed(rng, noise_px=0.3, noise_m=0.02)
    wrong = rng.random(len(tracked.camera)) < 0.05
    tracked.pixel[wrong] += rng.uniform(20, 40, (int(wrong.sum()), 2))
    tracked.depth_m[rng.random(len(wrong)) < 0.1] += 0.8
    found = optimized(displaced(truth, rng), tracked)
    assert np.linalg.norm(found[:, :3, 3] - truth[:, :3, 3], axis=1).max() < 0.01, "meters"


def test_depth_determines_only_the_scale():
    rng = np.random.default_rng(2)
    truth, tracked = observed(rng, noise_px=0.2, depth_scale=1.05)
    found = optimized(truth, tracked)
    length = np.linalg.norm(found[-1, :3, 3]) / np.linalg.norm(truth[-1, :3, 3])
    assert length == pytest.approx(1.05, abs=0.005)
    assert np.rad2deg(rigid.rotation_angle(found[:, :3, :3], truth[:, :3, :3])).max() < 0.2, "degrees"


def test_standard_deviations_are_estimated():
    rng = np.random.default_rng(3)
    truth, tracked = observed(rng, noise_px=0.8, noise_m=0.06)
    term = PointTerm(tracked, truth)
    normal, gradient = term.normal_equations(truth)
    assert term.sigma_px == pytest.approx(0.8, rel=0.2)
    assert term.depth_inflation * 0.02 == pytest.approx(2 * 0.06, rel=0.3), "twice; points take up some"
    assert abs(normal - sparse.csc_array(normal.T)).max() < 1e-6 * abs(normal).max()
    assert gradient.shape == (6 * CAMERAS,)


def test_lens_distortion_is_recovered():
    """Pixels are closer to the center than with a pinhole."""
    rng, radial = np.random.default_rng(5), 0.05
    truth, tracked = observed(rng)
    straight = (tracked.pixel - tracked.center_px) / FOCAL_PX
    shown = straight
    for _ in range(20):
        shown = straight / (1 + radial * (shown**2).sum(1, keepdims=True))
    tracked.pixel[:] = shown * FOCAL_PX + tracked.center_px
    term = PointTerm(tracked, truth)
    found = optimized(displaced(truth, rng), tracked, term)
    assert term.radial == pytest.approx(radial, abs=0.005)
    assert np.linalg.norm(found[:, :3, 3] - truth[:, :3, 3], axis=1).max() < 0.005, "meters"


def test_points_with_two_observations_in_a_picture_are_dropped():
    pixels = [np.array([[1.0, 2], [3, 4], [5, 6]]), np.array([[7.0, 8], [9, 10]])]
    depths, pinhole = [np.array([1.0, np.nan, 2]), np.array([3.0, 4])], np.repeat(np.eye(3)[None], 2, axis=0)
    links = [(0, 1, np.array([[0, 0], [1, 1], [2, 1]]))]
    found = build_tracks(pixels, depths, pinhole, np.array([0, 1]), links)
    assert found.pixel.tolist() == [[1, 2], [7, 8]] and found.depth_m.tolist() == [1, 3]
    assert found.camera.tolist() == found.lens.tolist() == [0, 1] and found.points == 1


def test_covisibility_counts_shared_points():
    _, tracked = observed(np.random.default_rng(4))
    assert (tracked.covisibility(CAMERAS) == POINTS).all()
