"""The rasterizer agrees with ray casting, also for triangles that cross the camera plane."""

import numpy as np

from pipeline.geometry import rigid
from pipeline.geometry.meshes import Mesh, RayCaster, render_view
from stages.synthesize_capture import raster

INTRINSICS = np.array([[90.0, 0, 40.3], [0, 88.0, 31.1], [0, 0, 1]])


def test_depth_agrees_with_embree():
    rng = np.random.default_rng(3)
    center = rng.uniform(-1.5, 1.5, (80, 1, 3)) + np.array([0, 0, 2.0])
    vertices = (center + rng.normal(0, 0.6, (80, 3, 3))).reshape(-1, 3).astype(np.float32)
    faces = np.arange(240).reshape(-1, 3).astype(np.int32)
    world_from_camera = rigid.exp(np.array([0.1, -0.2, 0.05, 0.1, 0.0, 0.3]))
    expected, _hits = render_view(RayCaster(Mesh(vertices, faces)), world_from_camera, INTRINSICS, 64, 80)
    view = raster.rasterize(
        rigid.apply(rigid.inverse(world_from_camera), vertices), faces, INTRINSICS, 64, 80
    )
    seen = (expected > 2 * raster.NEAR_M) & (view.face >= 0)
    assert (seen == (expected > 2 * raster.NEAR_M)).mean() > 0.998, (
        "the same pixels are covered, but for edges"
    )
    agree = np.abs(1 / view.inverse_depth[seen] - expected[seen]) < 1e-3 * expected[seen]
    assert agree.mean() > 0.995, "the same depth, but for pixels on an edge"


def test_depth_at_another_resolution_is_exact_on_a_plane():
    wall = np.array([[-9, -9, 2.0], [9, -9, 2.0], [0, 18, 5.0]])
    view = raster.rasterize(wall, np.array([[0, 1, 2]], np.int32), INTRINSICS, 64, 80)
    depth = raster.depth_through(
        view.face, view.inverse_depth, view.inverse_corners, np.array([72.0, 66.0, 32.24, 23.325]), 48, 64
    )
    x, y = (np.arange(64) + 0.5 - 32.24) / 72, (np.arange(48) + 0.5 - 23.325) / 66
    expected = (2.0 + 1.0) / (1 - y / 9)  # the plane z = 3 + y / 9
    np.testing.assert_allclose(depth, np.broadcast_to(expected[:, None], (48, 64)), rtol=1e-5)
    assert x.size == 64
