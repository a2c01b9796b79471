import numpy as np
import trimesh

from pipeline.geometry import contact, rigid
from pipeline.geometry.contact import StandingSurface
from pipeline.geometry.meshes import Mesh, RayCaster, render_view

SIZE = (120, 160)
INTRINSICS = np.array([[120.0, 0, 80], [0, 120.0, 60], [0, 0, 1]])
EYE = np.array([0.0, 1.2, 2.0])
CAMERA = rigid.look_at(EYE, np.array([0.0, 0.2, 0.0]), np.array([0.0, 1.0, 0.0]))
BOX = trimesh.creation.box((0.3, 0.3, 0.2), rigid.make(np.eye(3), np.array([0.0, 0.15, 0.0])))


def mesh_caster(*meshes: trimesh.Trimesh) -> RayCaster:
    together = trimesh.util.concatenate(meshes)
    return RayCaster(Mesh(np.asarray(together.vertices, np.float32), np.asarray(together.faces)))


def caster(*meshes: trimesh.Trimesh) -> RayCaster:
    floor = trimesh.creation.box((6, 0.02, 6), rigid.make(np.eye(3), np.array([0.0, -0.01, 0.0])))
    return mesh_caster(floor, *meshes)


STANDING = StandingSurface(caster(), 0.0)


def render(scene: RayCaster) -> np.ndarray:
    return render_view(scene, CAMERA, INTRINSICS, *SIZE)[0]


def test_depth_of_a_box_on_the_floor():
    true, floor = render(caster(BOX)), render(caster())
    mask = true < floor - 1e-3
    touched = contact.find(mask, INTRINSICS, CAMERA, STANDING)
    assert touched.certain and abs(touched.point_world[1]) < 1e-3
    assert abs(touched.point_world[2] - 0.1) < 0.04, "its front stands at z = 0.1 m"
    depth = contact.depth_of(mask, touched.point_world, 0.3, INTRINSICS, CAMERA)
    assert ((depth > 0) == mask).all()
    assert np.abs(depth - true)[mask].max() < 0.06
    assert np.median(np.abs(depth - true)[mask]) < 0.03


def test_depth_seen_from_above_is_that_of_the_back():
    """The lowest pixels are its far side's if the phone looks straight down or beyond: there is no front."""
    eye = np.array([0.0, 1.5, 0.02])
    camera = rigid.look_at(eye, np.array([0.0, 0.0, 0.15]), np.array([0.0, 0.0, -1.0]))
    true, floor = (render_view(scene, camera, INTRINSICS, *SIZE)[0] for scene in (caster(BOX), caster()))
    mask = true < floor - 1e-3
    touched = contact.find(mask, INTRINSICS, camera, STANDING)
    depth = contact.depth_of(mask, touched.point_world, 0.3, INTRINSICS, camera)
    assert ((depth > 0) == mask).all()
    assert np.median(np.abs(depth - true)[mask]) < 0.03
    assert depth.max() < floor.max() + 0.05, "nothing is below the floor"


def test_no_contact_at_picture_borders_or_in_front_of_walls():
    cut = np.zeros(SIZE, bool)
    cut[80:, 70:90] = True
    assert not contact.find(cut, INTRINSICS, CAMERA, STANDING).certain
    wall = trimesh.creation.box((6, 3, 0.02), rigid.make(np.eye(3), np.array([0.0, 1.5, -0.5])))
    high = np.zeros(SIZE, bool)
    high[5:20, 70:90] = True
    assert not contact.find(high, INTRINSICS, CAMERA, StandingSurface(caster(wall), 0.0)).certain


def test_contact_in_a_hole_of_the_map_is_on_the_floor_beyond_a_table():
    """The map shows a table and a far wall, but not the floor between them where the animal stands."""
    table = trimesh.creation.box((2, 0.02, 0.6), rigid.make(np.eye(3), np.array([0.0, 0.5, 1.5])))
    wall = trimesh.creation.box((6, 3, 0.02), rigid.make(np.eye(3), np.array([0.0, 1.5, -3.0])))
    mask = render(caster(BOX)) < render(caster()) - 1e-3
    touched = contact.find(mask, INTRINSICS, CAMERA, StandingSurface(mesh_caster(table, wall), 0.0))
    assert touched.certain and np.allclose(touched.point_world[1:], [0.0, 0.1], atol=0.04)
    alone = StandingSurface(mesh_caster(table), 0.0)
    assert contact.find(mask, INTRINSICS, CAMERA, alone) is None, "outside of what the map spans"


def test_contacts_are_extrapolated_for_a_limited_time():
    seen = contact.Contact(np.array([1.0, 0, 0]), True)
    later = contact.Contact(np.array([2.0, 0, 0]), True)
    hidden = contact.Contact(np.array([9.0, 0, 0]), False)
    time_s = np.array([0.0, 0.5, 1.0, 9.0])
    points = contact.between(time_s, [seen, hidden, later, None], 2.0)
    assert np.allclose(points[1], [1.5, 0, 0])
    assert np.isnan(points[3]).all()
