import numpy as np
import pytest
import torch

from pipeline.geometry import signed_distance
from pipeline.geometry.meshes import Mesh
from tests.pipeline.longterm.strider import box, merged, room


@pytest.fixture(scope="module")
def scene():
    return signed_distance.from_mesh(
        room(), np.array([-2.2, -0.3, -2.2]), np.array([2.2, 0.9, 2.2]), voxel_m=0.05
    )


def true_distance(points):
    """Distance to the inner faces of a room and to a block that is sunk 0.1 m into the floor, without the
    covered floor.
    """
    walls = np.min([2 - np.abs(points[:, 0]), points[:, 1], 2 - np.abs(points[:, 2])], axis=0)
    away = np.abs(points - [0, 0.2, 0]) - [0.4, 0.3, 0.4]
    block = np.linalg.norm(np.maximum(away, 0), axis=1) + np.minimum(away.max(1), 0)
    return np.where((away < 0).all(1), block, np.minimum(walls, block))


def test_distance_is_correct_in_free_space_and_in_the_block(scene):
    rng = np.random.default_rng(0)
    points = rng.uniform([-1.9, 0.05, -1.9], [1.9, 0.6, 1.9], (4000, 3))
    off = scene.at(torch.from_numpy(points)).numpy() - true_distance(points)
    assert np.abs(off).max() < 0.05  # a voxel, at edges and half way between walls
    assert np.median(np.abs(off)) < 0.004


def test_distance_is_negative_below_the_floor_and_clamped_outside_the_grid(scene):
    points = torch.tensor([[1.0, -0.1, 1.0], [1.0, -5.0, 1.0], [1.0, 0.1, 1.0]])
    below, far, above = scene.at(points).tolist()
    assert below == pytest.approx(-0.1, abs=0.01)
    assert far == pytest.approx(-0.3, abs=0.06)
    assert above == pytest.approx(0.1, abs=0.01)


def test_gradient_points_away_from_the_surface(scene):
    points = torch.tensor([[1.0, 0.1, 1.0], [0.6, 0.25, 0.0]], requires_grad=True)
    scene.at(points).sum().backward()
    torch.testing.assert_close(
        points.grad, torch.tensor([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]), atol=0.05, rtol=0
    )


def test_axes_are_not_swapped():
    """Checks the order of axes and points outside the grid."""
    thin = signed_distance.from_mesh(
        box([0, 0, 0], [1.0, 0.4, 0.2]), np.array([-0.2] * 3), np.array([1.2, 0.6, 0.4]), voxel_m=0.02
    )
    inside = torch.tensor([[0.9, 0.2, 0.1], [0.5, 0.39, 0.1], [0.5, 0.2, 0.19]])
    outside = torch.tensor([[1.1, 0.2, 0.1], [0.5, 0.5, 0.1], [0.5, 0.2, 0.3]])
    assert (thin.at(inside) < 0).all()
    torch.testing.assert_close(thin.at(outside), torch.full((3,), 0.1), atol=0.01, rtol=0)


def test_sign_of_open_meshes():
    """A block without a bottom on a floor, and a single sheet in the air with free space behind it."""
    block = box([-0.3, 0, -0.3], [0.3, 0.4, 0.3])
    lidless = Mesh(block.vertices, block.faces[np.abs(block.face_normals()[:, 1] + 1) > 1e-3])
    floor = Mesh(
        np.array([[-2, 0, -2], [2, 0, -2], [2, 0, 2], [-2, 0, 2]], np.float32),
        np.array([[0, 2, 1], [0, 3, 2]]),
    )
    leaf = Mesh(np.array([[1, 0.5, 1], [1.2, 0.5, 1], [1, 0.5, 1.2]], np.float32), np.array([[0, 2, 1]]))
    scene = signed_distance.from_mesh(
        merged(lidless, floor, leaf), np.array([-1.5, -0.2, -1.5]), np.array([1.5, 0.8, 1.5]), voxel_m=0.05
    )
    assert scene.at(torch.tensor([[0.0, 0.2, 0.0]])) < -0.1
    assert scene.at(torch.tensor([[1.05, 0.4, 1.05]])) > 0.05


def test_fragments_inside_a_block_are_ignored():
    """Fusion leaves spurious fragments in walls; distances and signs must not depend on them."""
    rng = np.random.default_rng(0)
    corners = rng.uniform([-0.3, 0.05, -0.3], [0.3, 0.65, 0.3], (60, 1, 3)) + rng.uniform(
        -0.03, 0.03, (60, 3, 3)
    )
    crumbs = Mesh(corners.reshape(-1, 3).astype(np.float32), np.arange(180).reshape(60, 3))
    block = merged(box([-0.5, 0, -0.5], [0.5, 0.7, 0.5]), crumbs)
    scene = signed_distance.from_mesh(
        block, np.array([-0.7, -0.1, -0.7]), np.array([0.7, 0.9, 0.7]), voxel_m=0.04
    )
    inside = rng.uniform([-0.45, 0.05, -0.45], [0.45, 0.65, 0.45], (500, 3))
    depth = np.minimum((0.5 - np.abs(inside[:, [0, 2]])).min(1), 0.35 - np.abs(inside[:, 1] - 0.35))
    off = -scene.at(torch.from_numpy(inside).float()).numpy() - depth
    assert np.quantile(np.abs(off), 0.98) < 0.04, "a voxel"


def test_surface_samples_are_uniform():
    spread = signed_distance.surface_points(room(), 0.1)
    assert len(spread.points) == pytest.approx(
        (4 * 4 * 2 + 4 * 4 * 2 + 2 * 0.64 + 4 * 0.8 * 0.6) / 0.01, rel=0.01
    )
    again = signed_distance.surface_points(room(), 0.1)
    np.testing.assert_array_equal(spread.points, again.points)
