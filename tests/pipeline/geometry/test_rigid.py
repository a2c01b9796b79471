"""Rigid transforms: group laws, agreement of NumPy and torch, finite gradients."""

import numpy as np
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays as random_arrays

from pipeline.geometry import rigid, rigid_torch

twists = random_arrays(np.float64, (3, 6), elements=st.floats(-1.7, 1.7))


@given(twists)
@settings(max_examples=50, deadline=None)
def test_exp_log_inverse_are_consistent(twist):
    a_from_b = rigid.exp(twist)
    assert np.allclose(rigid.exp(rigid.log(a_from_b)), a_from_b, atol=1e-9)
    assert np.allclose(a_from_b @ rigid.inverse(a_from_b), np.eye(4), atol=1e-12)


@given(twists)
@settings(max_examples=50, deadline=None)
def test_torch_agrees_with_numpy(twist):
    a_from_b = rigid_torch.se3_exp(torch.from_numpy(twist))
    assert np.allclose(a_from_b.numpy(), rigid.exp(twist), atol=1e-9)
    quaternion = rigid_torch.quaternion_from_rotation(a_from_b[:, :3, :3])
    assert np.allclose(
        rigid_torch.rotation_from_quaternion(quaternion).numpy(), a_from_b[:, :3, :3].numpy(), atol=1e-9
    )
    columns = rigid_torch.rotation_to_6d(a_from_b[:, :3, :3])
    assert np.allclose(rigid_torch.rotation_from_6d(columns).numpy(), a_from_b[:, :3, :3].numpy(), atol=1e-9)


def test_gradients_are_correct_at_and_near_the_identity():
    vector = torch.tensor(
        [[0.0, 0, 0], [1e-5, 0, 0], [0.3, -1.0, 2.0]], dtype=torch.double, requires_grad=True
    )
    assert torch.autograd.gradcheck(rigid_torch.so3_exp, vector)


def test_rotation_angle_is_exact_for_tiny_and_half_turns():
    for angle in (0.0, 1e-7, 1.0, np.pi):
        rotation = rigid.rotation_from_vector(np.array([0.0, angle, 0.0]))
        assert abs(rigid.rotation_angle(np.eye(3), rotation) - angle) < 1e-9


def test_interpolation_passes_through_knots_and_is_constant_outside():
    rng = np.random.default_rng(0)
    knots = rigid.exp(rng.normal(size=(4, 6)))
    times = np.array([0.0, 1.0, 2.5, 3.0])
    assert np.allclose(rigid.interpolate(times, knots, times), knots)
    assert np.allclose(rigid.interpolate(times, knots, np.array([-1.0, 9.0])), knots[[0, -1]])


def test_look_at_is_upright_and_faces_the_target():
    world_from_camera = rigid.look_at(
        np.array([1.0, 1.5, 2.0]), np.array([0.0, 0.5, 0.0]), np.array([0.0, 1.0, 0.0])
    )
    target_camera = rigid.apply(rigid.inverse(world_from_camera), np.array([[0.0, 0.5, 0.0]]))[0]
    assert np.allclose(target_camera[:2], 0) and target_camera[2] > 0
    assert world_from_camera[1, 1] < 0 and abs(world_from_camera[1, 0]) < 1e-12
