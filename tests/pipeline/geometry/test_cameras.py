"""Projection inverts back-projection; resizing and rotating pictures transform intrinsics consistently."""

import numpy as np
import torch

from pipeline.geometry import cameras, rigid

INTRINSICS = np.array([[230.0, 0, 121.3], [0, 228.0, 158.2], [0, 0, 1]])


def test_projection_inverts_back_projection():
    depth = np.random.default_rng(0).uniform(0.3, 5, (32, 24))
    pixel, z = cameras.project(cameras.back_project(depth, INTRINSICS), INTRINSICS)
    assert np.allclose(pixel, cameras.pixel_grid(32, 24)) and np.allclose(z, depth)
    pixel_torch, _ = cameras.project(
        torch.from_numpy(cameras.back_project(depth, INTRINSICS)), torch.from_numpy(INTRINSICS)
    )
    assert np.allclose(pixel_torch.numpy(), pixel)


def test_lookups_return_what_was_back_projected_and_nothing_out_of_view():
    rng = np.random.default_rng(0)
    depth = rng.uniform(0.3, 5, (320, 240)).astype(np.float32)
    points = cameras.back_project(depth, INTRINSICS)
    assert np.array_equal(cameras.lookup_depth(depth, INTRINSICS, points), depth)
    assert not cameras.lookup_depth(depth, INTRINSICS, -points).any()
    assert not cameras.lookup_depth(depth, INTRINSICS, points, nearest_m=5.0).any()
    pixel = rng.uniform([0, 0], [240, 320], (500, 2))
    row, column = cameras.pixel_index(pixel)
    assert np.array_equal(cameras.sample_nearest(depth, pixel), depth[row, column])
    assert np.abs(cameras.pixel_centers(row, column) - pixel).max() <= 0.5
    assert not cameras.sample_nearest(depth, pixel + np.array([240, 0])).any()
    at_centers = cameras.sample_bilinear(depth, cameras.pixel_grid(320, 240))
    assert np.array_equal(at_centers, depth)
    small = cameras.scale_intrinsics(INTRINSICS, (320, 240), (640, 480))
    own = cameras.back_project_pixels(cameras.pixel_grid(640, 480), small, depth, INTRINSICS)
    assert np.array_equal(own[..., 2], depth.repeat(2, 0).repeat(2, 1))


def test_resizing_scales_pixel_coordinates():
    point = np.array([[0.2, -0.1, 1.5]])
    pixel, _ = cameras.project(point, INTRINSICS)
    small, _ = cameras.project(point, cameras.scale_intrinsics(INTRINSICS, (320, 240), (160, 60)))
    assert np.allclose(small, pixel * [60 / 240, 160 / 320])


def test_rotated_picture_has_consistent_intrinsics_and_pose():
    rng = np.random.default_rng(1)
    world_from_camera = rigid.exp(rng.normal(size=6))
    points_camera = np.stack(
        [rng.uniform(-0.2, 0.2, 50), rng.uniform(-0.3, 0.3, 50), rng.uniform(1, 2, 50)], -1
    )
    points_world = rigid.apply(world_from_camera, points_camera)
    size = (320, 240)
    image = np.zeros(size)
    pixel, _ = cameras.project(points_camera, INTRINSICS)
    image[pixel[:, 1].astype(int), pixel[:, 0].astype(int)] = 1
    for turns in range(4):
        turned = cameras.turn_image(image, turns)
        turned_world_from_camera = cameras.turn_camera(world_from_camera, turns)
        turned_intrinsics = cameras.turn_intrinsics(INTRINSICS, size, turns)
        pixel, z = cameras.project(
            rigid.apply(rigid.inverse(turned_world_from_camera), points_world), turned_intrinsics
        )
        assert (z > 0).all()
        assert turned[pixel[:, 1].astype(int), pixel[:, 0].astype(int)].all(), turns
