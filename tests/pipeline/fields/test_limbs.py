"""Kinematic trees: a rotation moves all descendants of a bone; low frequencies move many frames."""

import torch

from pipeline.fields.limbs import KinematicTree, MultiscaleRotations
from pipeline.geometry import rigid_torch

LENGTH_M = 0.1
"""between bones"""


def chain() -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Return points, weights and bones of a body at 0 with one bone in front and a tail of three, in random
    order.
    """
    place = LENGTH_M * torch.tensor([-2.0, 0.0, -3.0, 1.0, -1.0])
    bones = torch.eye(4).repeat(5, 1, 1)
    bones[:, 2, 3] = place
    points = torch.stack([torch.zeros(81), torch.zeros(81), torch.linspace(-0.32, 0.12, 81)], dim=-1)
    weights = (-(points[:, None, 2] - place).square() / 0.04**2).softmax(-1)
    return points, weights, bones


def test_tree_is_rooted_at_the_center():
    limbs = KinematicTree.of(*chain())
    parent = dict(zip(limbs.order.tolist(), limbs.order[limbs.parent].tolist(), strict=True))
    assert parent == {1: 1, 3: 1, 4: 1, 0: 4, 2: 0}
    at = dict(zip(limbs.order.tolist(), limbs.joint[:, 2].tolist(), strict=True))
    assert abs(at[0] + 1.5 * LENGTH_M) < 0.01, "half-way between the two bones that share the skin there"


def test_rotation_at_the_root_moves_the_whole_tail():
    points, weights, bones = chain()
    limbs = KinematicTree.of(points, weights, bones)
    turn = torch.zeros(2, 5, 3)
    turn[1, 4, 0] = torch.pi / 2
    moved = limbs.motion(turn) @ bones
    torch.testing.assert_close(moved[0], bones, msg="no turn, no motion")
    torch.testing.assert_close(
        moved[1, [1, 3]], bones[[1, 3]], msg="the middle and what hangs elsewhere stay"
    )
    joint = limbs.joint[limbs.order == 4][0]
    reach = bones[[4, 0, 2], 2, 3] - joint[2]
    torch.testing.assert_close(
        moved[1, [4, 0, 2], :3, 3],
        torch.stack([0 * reach, -reach, joint[2].expand(3)], dim=-1),
        atol=1e-5,
        rtol=0,
    )
    relative = rigid_torch.inverse(moved[1, 4]) @ moved[1, 2]
    torch.testing.assert_close(relative, rigid_torch.inverse(bones[4]) @ bones[2], msg="straight as before")


def test_parent_of_a_leg_is_the_body():
    """Two legs share more skin with each other than with the body above them."""
    place = torch.tensor(
        [[0.02, 0, 0], [-0.04, 0.02, 0.08], [0.04, 0.02, 0.08], [-0.04, -0.08, 0.1], [0.04, -0.08, 0.1]]
    )
    bones = torch.eye(4).repeat(5, 1, 1)
    bones[:, :3, 3] = place
    middle = (place[:, None] + place) / 2
    weights = torch.zeros(5, 5, 5)
    share = {(0, 1): 6, (0, 2): 6, (1, 2): 4, (1, 3): 3, (2, 4): 3, (3, 4): 5}
    for (one, other), points in share.items():
        weights[one, other, [one, other]] = points / 20
    weights[range(5), range(5), range(5)] = 1.0
    on_skin = weights.sum(-1) > 0
    limbs = KinematicTree.of(middle[on_skin], weights[on_skin], bones)
    parent = dict(zip(limbs.order.tolist(), limbs.order[limbs.parent].tolist(), strict=True))
    assert parent == {0: 0, 1: 0, 2: 0, 3: 1, 4: 2}


def test_temporal_basis_adds_knots_of_each_scale():
    waves = MultiscaleRotations(frames=20, bones=1, knot_frames=(8,))
    assert waves().shape == (20, 1, 3) and not waves().any()
    with torch.no_grad():
        waves.knots[0][1] = 1.0
        waves.each[3] += 0.5
    expected = (1 - (torch.arange(20.0) - 8).abs() / 8).clamp_min(0)
    expected[3] += 0.5
    torch.testing.assert_close(waves()[:, 0, 0].detach(), expected)
