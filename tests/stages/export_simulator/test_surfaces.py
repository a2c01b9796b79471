"""Simplified surfaces keep their shape; resampled motion passes through its frames."""

import numpy as np
import pytest

from pipeline.geometry import rigid
from pipeline.geometry.decimation import decimate
from pipeline.geometry.meshes import Mesh
from stages.export_simulator import actions, surfaces
from tests.stages.export_simulator import small_world


def test_simplification_keeps_the_shape() -> None:
    room = small_world.room()
    light, nearest = decimate(room, 200)
    assert len(light.faces) <= 220
    assert nearest.shape == (len(light.vertices),)
    np.testing.assert_allclose(
        surfaces.extent(light, np.zeros((1, 3))).bounds_m,
        surfaces.extent(room, np.zeros((1, 3))).bounds_m,
        atol=0.2,
    )


@pytest.mark.parametrize("height_m", [0.0, -1.3])
def test_floor_is_found_under_furniture(height_m: float) -> None:
    room = small_world.room()
    table = small_world.room()
    lifted = Mesh(room.vertices * [1, 1, 1] + [0, height_m, 0], room.faces, room.color)
    top = Mesh(table.vertices[:289] * [0.4, 0, 0.4] + [0, height_m + 0.5, 0], table.faces[:512], None)
    both = Mesh(
        np.concatenate([lifted.vertices, top.vertices]),
        np.concatenate([lifted.faces, top.faces + len(lifted.vertices)]),
    )
    found = surfaces.floor_height_m(both, np.array([[0.0, height_m + 0.8, 0.0]]))
    assert abs(found - height_m) < 0.01, "meters"


def test_walls_face_inwards() -> None:
    room = small_world.room()
    inside_out = Mesh(room.vertices, np.ascontiguousarray(room.faces[:, ::-1]), room.color)
    for mesh in (room, inside_out):
        turned = surfaces.orient_towards(mesh, np.array([0.1, 1.0, 0.2]))
        towards = np.array([0.1, 1.0, 0.2]) - turned.vertices[turned.faces].mean(1)
        assert ((turned.face_normals() * towards).sum(-1) > 0).all()


def test_strong_splats_are_kept_and_invalid_ones_dropped() -> None:
    rows = np.zeros((4, 62), np.float32)
    rows[:, 54] = [4, -20, 2, 4]
    rows[:, 55:58] = -3
    rows[:, 58] = 1
    rows[:, 0] = [0, 1, 2, np.nan]
    packed = np.frombuffer(surfaces.splat_rows(rows, 10), np.uint8).reshape(-1, 32)
    assert packed[:, :4].copy().view("<f4").ravel().tolist() == [0.0, 2.0]
    assert len(surfaces.splat_rows(rows, 1)) == 32


def test_resampling_passes_through_the_frames() -> None:
    track = small_world.trajectory(21, 0)
    motion = actions.SessionClip(
        "v", track.timestamp_s, track.world_from_agent, track.agent_from_bone, track.world_from_camera
    )
    even = actions.animation(motion, 30.0)
    assert len(even.time_s) == 61
    np.testing.assert_allclose(even.world_from_agent[::3], track.world_from_agent, atol=1e-6)
    turn = rigid.rotation_angle(even.world_from_agent[1:, :3, :3], even.world_from_agent[:-1, :3, :3])
    np.testing.assert_allclose(turn, 0.05 / 3, atol=1e-6)


@pytest.mark.parametrize(
    ("valid", "expected"), [([0, 1, 1, 0, 1], (1, 3)), ([1, 1, 1], (0, 3)), ([0, 0], (0, 0))]
)
def test_longest_run(valid: list[int], expected: tuple[int, int]) -> None:
    found = actions.longest_run(np.array(valid, bool))
    assert (found.start, found.stop) == expected
