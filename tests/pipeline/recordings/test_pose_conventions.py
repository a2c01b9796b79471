"""Detection of pose conventions from depth: wrong conventions are found, meaningless poses are refused."""

import numpy as np
import pytest

from pipeline.geometry import cameras, rigid
from pipeline.geometry.meshes import RayCaster
from pipeline.recordings import conventions, upright
from tests.stages import textured_room
from tests.stages.extract_frames.made_recordings import COLOR_SIZE, DEPTH_SIZE, walk


def _check(made, pose, size=1.0, unit=1.0):
    """Check poses of a walk through a room scaled by a factor, with LiDAR noise, in some unit."""
    intrinsics = cameras.scale_intrinsics(made.intrinsics, COLOR_SIZE, DEPTH_SIZE)
    rng = np.random.default_rng(0)

    def view(frame):
        noisy = size * made.depth(frame) + rng.normal(0, 0.003, DEPTH_SIZE)
        return conventions.DepthPicture(unit * noisy, intrinsics)

    return conventions.check_poses(pose, made.timestamp_s, view)


def _stored(made, convention):
    """Convert true poses to the convention of another app."""
    camera = cameras.turn_camera(made.world_from_camera, convention.quarter_turns)
    if convention.axes == "opengl":
        camera = cameras.opencv_from_opengl(camera)
    if convention.direction == "world_to_camera":
        camera = rigid.inverse(camera)
    wxyz = rigid.quaternion_from_rotation(camera[:, :3, :3])
    order = -1 if convention.quaternion == "xyzw" else 0
    return np.concatenate([np.roll(wxyz, order, axis=1), camera[:, :3, 3]], axis=1)


@pytest.mark.parametrize("convention", conventions.CONVENTIONS)
def test_reading_inverts_writing(convention):
    made = walk()
    read = conventions.odometry_from_pose(_stored(made, convention), convention)
    np.testing.assert_allclose(read, made.world_from_camera, atol=1e-9)


def test_documented_convention_is_kept():
    made = walk(40)
    check = _check(made, made.poses())
    assert check.verdict == "documented"
    assert check.residual_m < 0.025  # a 24 x 32 picture steps 30 mm per pixel along a wall


@pytest.mark.parametrize(
    "changes", [{"axes": "opencv"}, {"direction": "world_to_camera"}, {"quarter_turns": 1}]
)
def test_other_conventions_are_detected(changes):
    made = walk(60)
    convention = conventions.Convention(**changes)
    check = _check(made, _stored(made, convention))
    assert check.verdict == "other"
    relative = [
        rigid.inverse(poses[0]) @ poses[-1]
        for poses in (made.world_from_camera, _read(made, convention, check))
    ]
    np.testing.assert_allclose(relative[0], relative[1], atol=1e-6)


def _read(made, convention, check):
    return conventions.odometry_from_pose(_stored(made, convention), check.convention)


def test_meaningless_poses_are_refused():
    made = walk(40)
    pose = made.poses()
    rng = np.random.default_rng(0)
    shuffled = pose[rng.permutation(len(pose))] + np.concatenate(
        [np.zeros((40, 4)), rng.normal(0, 1, (40, 3))], 1
    )
    for bad in (
        None,
        np.zeros_like(pose),
        np.repeat(pose[:1], 40, 0),
        np.where(pose == pose[3], np.nan, pose),
        shuffled,
    ):
        assert _check(made, bad).verdict == "unusable"


@pytest.mark.parametrize("size", [1.0, 3.0])
def test_drifting_poses_are_accepted_in_rooms_of_any_size(size):
    made = walk(40)
    pose = made.poses()
    pose[:, 4:] += 0.08 * made.timestamp_s[:, None]
    pose[:, 4:] *= size
    check = _check(made, pose, size)
    assert check.verdict == "documented"
    assert check.tolerance_m < check.residual_m < 4 * check.tolerance_m


@pytest.mark.parametrize(
    ("unit", "factor", "speed"),
    [
        (0.1, 10, 0.3),
        (0.1, 10, 1),
        (0.2, 5, 0.3),
        (0.5, 2, 1),
        (1, 1, 0.3),
        (1, 1, 1),
        (2, 0.5, 1),
        (10, 0.1, 0.3),
    ],
)
def test_depth_in_another_unit_is_not_taken_for_drift(unit, factor, speed):
    """Near depth differs by few centimeters even if its unit is wrong."""
    made = walk(60)
    made.timestamp_s[:] /= speed
    check = _check(made, made.poses(), unit=unit)
    assert check.depth_factor == factor
    assert (check.verdict == "unusable") == (unit != 1)


@pytest.mark.parametrize("shake_m", [0.03, 0.06, 0.1, 0.2])
def test_shaking_poses_of_a_turning_phone_are_not_taken_for_another_unit(shake_m):
    made, rng = walk(60), np.random.default_rng(0)
    made.world_from_camera[:, :3, 3] = made.world_from_camera[0, :3, 3]
    pose = made.poses()
    pose[:, 4:] += rng.normal(0, shake_m / np.sqrt(3), (60, 3))
    assert _check(made, pose).depth_factor == 1


def test_static_phone_is_inconclusive():
    made = walk(40)
    made.world_from_camera[:] = made.world_from_camera[0]
    made.world_from_camera[:, 0, 3] += np.linspace(0, 0.01, 40)
    assert _check(made, made.poses()).verdict == "untested"


@pytest.mark.parametrize("turns", range(4))
def test_gravity_gives_the_upright_rotation(turns):
    stored = cameras.turn_camera(walk().world_from_camera, turns)
    assert (turns + upright.quarter_turns_from_gravity(stored)) % 4 == 0


def test_downward_camera_is_not_rotated():
    down = rigid.look_at(np.array([1.0, 2, 1]), np.array([1.0, 0, 1.001]), np.array([0.0, 0, 1]))
    assert upright.quarter_turns_from_gravity(cameras.turn_camera(down[None], 1)) == 0


@pytest.mark.parametrize("turns", range(4))
def test_surfaces_give_the_upright_rotation_without_poses(turns):
    room = textured_room.MemoryClip(
        RayCaster(textured_room.textured_room(edge_m=0.2)), textured_room.walk(6), None
    )
    intrinsics = cameras.turn_intrinsics(textured_room.INTRINSICS, textured_room.SIZE, -turns)
    stored = [(cameras.turn_image(room.depth(frame), -turns), intrinsics) for frame in range(6)]
    assert upright.quarter_turns_from_surfaces(stored) == turns
    assert upright.quarter_turns_from_surfaces([(np.zeros_like(stored[0][0]), intrinsics)]) == 0
