"""The kinematic tree of the bones, so that the rotation of a thigh moves the whole leg.

Gaussian bones have no parents; the maximum spanning tree over shared skinning weights defines them.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree
from torch import Tensor, nn

from pipeline.geometry import rigid_torch

MIN_SHARE = 1e-9
"""lower bound of shared skinning weight; keeps logarithms finite"""
MAX_SHARE = 0.999
"""upper bound: a sparse graph drops edges of length 0"""
LOW, GROUND = 0.45, 0.15
"""legs lie below the first share of the animal's height and reach below the second"""


def shared_skin(weights: Float[Tensor, "point bone"]) -> Float[Tensor, "bone bone"]:
    """Return the cosine similarity of the skinning weights of each pair of bones, 0..1; 0 on the diagonal."""
    share = weights.T @ weights
    size = share.diagonal().sqrt().clamp_min(1e-6)
    return (share / size[:, None] / size).fill_diagonal_(0)


@dataclass(frozen=True)
class KinematicTree:
    """Each bone's parent, and the joint about which it turns."""

    order: Int[Tensor, "bone"]
    """from the middle of the body outward, parents before children"""
    parent: Int[Tensor, "bone"]
    """of each bone in that order, as a place in that order; the middle's is itself"""
    joint: Float[Tensor, "bone 3"]
    """where each bone in that order meets its parent, at rest, agent frame, metres"""

    @classmethod
    def of(
        cls,
        points: Float[Tensor, "point 3"],
        weights: Float[Tensor, "point bone"],
        agent_from_bone_rest: Float[Tensor, "bone 4 4"],
    ) -> "KinematicTree":
        """Build the maximum spanning tree of shared skin from the bone nearest to the agent's origin."""
        cost = -np.log(shared_skin(weights).double().numpy().clip(MIN_SHARE, MAX_SHARE))
        tree = minimum_spanning_tree(cost)
        centre = agent_from_bone_rest[:, :3, 3]
        order, parent = breadth_first_order(tree + tree.T, int(centre.norm(dim=-1).argmin()), directed=False)
        order = torch.from_numpy(order).long()
        parent = torch.from_numpy(parent).long()[order]
        parent[0] = order[0]
        both = weights[:, order] * weights[:, parent] + MIN_SHARE
        return cls(order, order.argsort()[parent], both.T @ points / both.sum(0)[:, None])

    def motion(self, turn: Float[Tensor, "frame bone 3"]) -> Float[Tensor, "frame bone 4 4"]:
        """Return each bone's motion in the agent frame by forward kinematics: rotations about joints.

        The root bone is fixed: it moves with the agent's root.
        """
        rotation = rigid_torch.so3_exp(turn[:, self.order])
        local = rigid_torch.make(rotation, self.joint - (rotation @ self.joint[..., None])[..., 0])
        moved = [torch.eye(4, device=turn.device).expand(len(turn), 4, 4)]
        for place, parent in enumerate(self.parent.tolist()[1:], start=1):
            moved.append(moved[parent] @ local[:, place])
        return torch.stack(moved, dim=1)[:, self.order.argsort()]


def legs(
    limbs: KinematicTree, points: Float[Tensor, "point 3"], weights: Float[Tensor, "point bone"]
) -> Bool[Tensor, "bone"]:
    """Return the top bone of each leg: it and its descendants are low, and one of them reaches the ground."""
    height = (points[:, 1] - points[:, 1].min()) / (points[:, 1].max() - points[:, 1].min())
    low, bones = weights.T @ height < LOW * weights.sum(0), range(weights.shape[1])
    stands = torch.stack([(height[weights.argmax(1) == bone] < GROUND).any() for bone in bones])
    low, stands, parent = low[limbs.order], stands[limbs.order], limbs.parent.tolist()
    for place in range(len(parent) - 1, 0, -1):
        low[parent[place]] &= low[place]
        stands[parent[place]] |= stands[place]
    return (low & stands & ~low[limbs.parent])[limbs.order.argsort()]


class MultiscaleRotations(nn.Module):
    """Rotation vectors over consecutive frames: sums of linear splines on several time scales.

    Coarse knots make slow motion converge in fewer steps than per-frame parameters would.
    """

    def __init__(self, frames: int, bones: int, knot_frames: tuple[int, ...]):
        super().__init__()
        self.each = nn.Parameter(torch.zeros(frames, bones, 3))
        self.knots = nn.ParameterList(
            nn.Parameter(torch.zeros((frames - 1) // span + 2, bones, 3)) for span in knot_frames
        )
        self.knot_frames = knot_frames

    def forward(self) -> Float[Tensor, "frame bone 3"]:
        """Return the sum in every frame."""
        total, frame = self.each, torch.arange(len(self.each), device=self.each.device)
        for span, knots in zip(self.knot_frames, self.knots, strict=True):
            before, share = frame // span, ((frame % span) / span)[:, None, None]
            total = total + torch.lerp(knots[before], knots[before + 1], share)
        return total
