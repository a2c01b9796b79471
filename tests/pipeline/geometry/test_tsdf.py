"""TSDF fusion reconstructs a rendered box within a fraction of a voxel, with holes where nothing was
observed.
"""

import numpy as np
import trimesh

from pipeline.geometry import rigid, tsdf
from pipeline.geometry.meshes import Mesh, RayCaster, render_view

K = np.array([[80.0, 0, 48], [0, 80, 64], [0, 0, 1]])


def test_room_is_fused_where_it_was_observed():
    room = trimesh.creation.box((3.0, 2.0, 3.0))
    room.invert()
    caster = RayCaster(Mesh(np.asarray(room.vertices, np.float32), np.asarray(room.faces, np.int32)))
    volume = tsdf.enclose(np.asarray(room.vertices), voxel_m=0.05, truncation_m=0.2, trim=0)
    for angle in np.linspace(-1.0, 1.0, 9):
        forward = np.array([np.sin(angle), 0.0, np.cos(angle)])
        camera = rigid.look_at(np.zeros(3), forward, np.array([0.0, 1.0, 0.0]))
        depth, _ = render_view(caster, camera, K, 128, 96)
        volume.integrate(depth, K, np.full((128, 96, 3), (10, 200, 90), np.uint8), K, camera)
    mesh = volume.surface(0.0)
    extent = np.array([1.5, 1.0, 1.5])
    off_wall = np.abs(np.abs(mesh.vertices) - extent).min(1)
    assert np.median(off_wall) < 0.01, "meters; a voxel is 0.05"
    assert np.quantile(off_wall, 0.95) < 0.05, "meters"
    assert mesh.vertices[:, 2].min() > -1.3, "the wall behind was never seen"
    assert (np.abs(mesh.color.astype(int) - (10, 200, 90)).max(1) <= 1).mean() > 0.99
    center = mesh.vertices[mesh.faces].mean(1)
    assert (np.einsum("fi,fi->f", mesh.face_normals(), -center) > 0).mean() > 0.99, (
        "normals point into free space"
    )
