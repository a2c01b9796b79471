"""Skinning weights are convex, blended motions are rigid, and backward skinning inverts forward skinning."""

import torch

from pipeline.fields import skinning
from pipeline.geometry import rigid_torch


def body(bones: int = 6, points: int = 200):
    generator = torch.Generator().manual_seed(0)
    rest = rigid_torch.se3_exp(torch.randn(bones, 6, generator=generator, dtype=torch.float64) * 0.3)
    scale = 0.05 + 0.1 * torch.rand(bones, 3, generator=generator, dtype=torch.float64)
    cloud = 0.3 * torch.randn(points, 3, generator=generator, dtype=torch.float64)
    return generator, rest, scale, cloud


def test_weights_are_softmax_of_scaled_distances():
    _, rest, scale, cloud = body()
    local = rigid_torch.apply(rigid_torch.inverse(rest), cloud[None]) / scale[:, None]
    expected = (-local.square().sum(-1).T).softmax(-1)
    torch.testing.assert_close(skinning.skinning_weights(cloud, rest, scale), expected)


def test_rest_pose_is_the_identity_and_a_shared_motion_is_rigid():
    generator, rest, scale, cloud = body()
    weights = skinning.skinning_weights(cloud, rest, scale)
    torch.testing.assert_close(skinning.move(skinning.blend(weights, rest, rest), cloud), cloud)
    shared = rigid_torch.se3_exp(torch.randn(3, 6, generator=generator, dtype=torch.float64) * 2)
    moved = skinning.move(skinning.blend(weights, shared[:, None] @ rest, rest), cloud)
    torch.testing.assert_close(moved, rigid_torch.apply(shared, cloud.expand(3, -1, -1)))


def test_antipodal_quaternions_do_not_cancel():
    """Two bones with rotations of nearly 180 degrees of opposite sign blend to 180 degrees."""
    rest = torch.eye(4, dtype=torch.float64).expand(2, 4, 4)
    angle = torch.tensor([torch.pi - 0.01, torch.pi + 0.01], dtype=torch.float64)
    twist = torch.zeros(2, 6, dtype=torch.float64)
    twist[:, 1] = angle
    blended = skinning.blend(torch.full((1, 2), 0.5, dtype=torch.float64), rigid_torch.se3_exp(twist), rest)
    half_turn = torch.tensor([0.0, 0.0, 1.0, 0.0], dtype=torch.float64)
    torch.testing.assert_close(blended[:4, 0] * blended[2, 0].sign(), half_turn)


def test_backward_inverts_forward_where_bones_agree():
    generator, rest, scale, cloud = body()
    posed = rest @ rigid_torch.se3_exp(torch.randn(6, 6, generator=generator, dtype=torch.float64) * 0.02)
    forward = skinning.move(skinning.blend(skinning.skinning_weights(cloud, rest, scale), posed, rest), cloud)
    weights = skinning.skinning_weights(forward, posed, scale)
    inverse = skinning.move(skinning.blend(weights, posed, rest), forward, inverse=True)
    assert (inverse - cloud).norm(dim=-1).median() < 0.003, "meters; joints bend by about a degree"


def test_gradients_are_finite_at_rest():
    _, rest, scale, cloud = body()
    twist = torch.zeros(6, 6, dtype=torch.float64, requires_grad=True)
    weights = skinning.skinning_weights(cloud, rest, scale)
    skinning.move(
        skinning.blend(weights, rest @ rigid_torch.se3_exp(twist), rest), cloud
    ).square().sum().backward()
    assert torch.isfinite(twist.grad).all() and twist.grad.abs().max() > 0
