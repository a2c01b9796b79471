"""Registration of depth to a surface: filtering of scans, facing correspondences, signed distances."""

import numpy as np
import trimesh

from pipeline.geometry import rigid
from pipeline.geometry.meshes import Mesh
from pipeline.mapping import depth_scans, pose_optimization

K = np.array([[60.0, 0, 32], [0, 60.0, 24], [0, 0, 1]])


def wall(z_m: float) -> Mesh:
    """A wall that faces -z, 4 m wide."""
    grid = trimesh.creation.box((4.0, 4.0, 0.02)).subdivide_to_size(0.08)
    front = grid.triangles_center[:, 2] < -0.009
    vertices = grid.vertices + np.array([0, 0, z_m + 0.01])
    return Mesh(vertices.astype(np.float32), grid.faces[front].astype(np.int32))


def test_scan_drops_discontinuities_and_distant_or_uncertain_depth():
    depth = np.full((48, 64), 2.0)
    depth[:, 40:] = 3.0
    depth[:8] = 0.0
    confidence = np.full(depth.shape, 2, np.uint8)
    confidence[40:] = 0
    ignore = np.zeros(depth.shape, bool)
    ignore[:, :10] = True
    found = depth_scans.scan(depth, K, stride=2, confidence=confidence, ignore=ignore, max_depth_m=2.5)
    row, column = np.unravel_index(found.pixel_index, depth.shape)
    assert row.min() >= 8
    assert row.max() < 40
    assert column.min() >= 10
    assert column.max() < 39
    assert np.allclose(found.points_camera[:, 2], 2.0)


def test_scan_is_subsampled_evenly():
    scan = depth_scans.scan(np.full((48, 64), 2.0), K, stride=2)
    few = scan.subsampled(100)
    assert len(few.points_camera) == len(few.sigma_m) == 100
    assert (
        np.abs(np.diff(np.searchsorted(scan.pixel_index, few.pixel_index)) - len(scan.sigma_m) / 100).max()
        < 1
    )
    assert np.array_equal(scan.subsampled(10**6).points_camera, scan.points_camera), (
        "below the limit nothing changes"
    )


def test_correspondences_align_a_camera_to_the_wall():
    place = depth_scans.SurfaceMap(wall(2.0))
    scan = depth_scans.scan(np.full((48, 64), 2.0), K, stride=4)
    off = rigid.exp(np.array([[0.02, -0.015, 0, 0, 0, 0.06]]))
    found = pose_optimization.optimize_poses(
        off,
        lambda poses, reach: place.correspondences(np.array([0]), [scan], poses, reach),
        None,
        reach_m=(0.2,) * 8,
    )
    seen = rigid.apply(found.world_from_camera[0], scan.points_camera)
    assert np.abs(seen[:, 2] - 2.0).max() < 1e-3, "meters"


def test_distance_is_signed_and_back_faces_are_no_correspondences():
    place = depth_scans.SurfaceMap(wall(2.0))
    assert np.allclose(place.distance(np.array([[0.0, 0, 1.9], [0.0, 0, 2.1]])), [0.1, -0.1], atol=1e-3)
    behind = rigid.exp(np.array([[0.0, np.pi, 0, 0, 0, 4.0]]))
    scan = depth_scans.scan(np.full((48, 64), 2.0), K, stride=4)
    assert len(place.correspondences(np.array([0]), [scan], behind, 0.2).first) == 0
