"""Ray casting: depth is z, attributes are interpolated, normals point outwards."""

import numpy as np

from pipeline.geometry import cameras, rigid
from pipeline.geometry.meshes import Mesh, RayCaster, render_view

WALL = Mesh(
    np.array([[-5.0, -5, 2], [5, -5, 2], [5, 5, 2], [-5, 5, 2]], np.float32),
    np.array([[0, 1, 2], [0, 2, 3]], np.int32),
)


def test_frontal_wall_has_constant_depth():
    intrinsics = np.array([[30.0, 0, 20], [0, 30, 15], [0, 0, 1]])
    depth, hits = render_view(RayCaster(WALL), np.eye(4), intrinsics, 30, 40)
    assert np.allclose(depth, 2.0, atol=1e-5)
    points = hits.interpolate(WALL, WALL.vertices).reshape(30, 40, 3)
    assert np.allclose(points, cameras.back_project(depth, intrinsics), atol=1e-4)


def test_missing_rays_are_marked():
    hits = RayCaster(WALL).cast(np.zeros((1, 3)), np.array([[0.0, 0, -1]]))
    assert hits.face[0] == -1 and np.isinf(hits.distance[0])


def test_normals_rotate_with_the_wall():
    turn = rigid.exp(np.array([0.4, 0.2, -0.9, 0, 0, 0]))
    turned = Mesh(rigid.apply(turn, WALL.vertices), WALL.faces)
    assert np.allclose(turned.vertex_normals(), WALL.vertex_normals() @ turn[:3, :3].T, atol=1e-6)
    assert np.allclose(turned.face_normals(), WALL.face_normals() @ turn[:3, :3].T, atol=1e-6)
