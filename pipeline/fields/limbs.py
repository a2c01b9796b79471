"""The kinematic tree of the bones, so that the rotation of a thigh moves the whole leg.

Gaussian bones have no parents; the tree of shortest paths from the middle of the body defines them.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.sparse.csgraph import dijkstra
from torch import Tensor, nn

from pipeline.geometry import rigid_torch

MIN_SHARE = 1e-9
"""added to shared skinning weight, so that averages over it are finite"""
MIN_SKIN = 0.02
"""shared skin from which two bones are neighbors"""
DETOUR = 1.5
"""cost of a path from the middle to a bone with none between, relative to its squared length"""


def shared_skin(weights: Float[Tensor, "point bone"]) -> Float[Tensor, "bone bone"]:
    """Return the cosine similarity of the skinning weights of each pair of bones, 0..1; 0 on the diagonal."""
    share = weights.T @ weights
    size = share.diagonal().sqrt().clamp_min(1e-6)
    return (share / size[:, None] / size).fill_diagonal_(0)


def joined(share: Float[Tensor, "bone bone"], most: int | None = None) -> Bool[Tensor, "bone bone"]:
    """Return which bones share skin: each with one neighbor at least and ``most`` of its own choice."""
    ranked = share.argsort(dim=1, descending=True)
    chosen = torch.zeros_like(share, dtype=torch.bool).scatter_(1, ranked[:, :most], True)
    chosen = (chosen & (share > MIN_SKIN)).scatter_(1, ranked[:, :1], True)
    return chosen | chosen.T


@dataclass(frozen=True)
class KinematicTree:
    """Each bone's parent, and the joint about which it turns."""

    order: Int[Tensor, "bone"]
    """from the middle of the body outward, parents before children"""
    parent: Int[Tensor, "bone"]
    """of each bone in that order, as a place in that order; the middle's is itself"""
    joint: Float[Tensor, "bone 3"]
    """where each bone in that order meets its parent, at rest, agent frame, meters"""

    @classmethod
    def of(
        cls,
        points: Float[Tensor, "point 3"],
        weights: Float[Tensor, "point bone"],
        agent_from_bone_rest: Float[Tensor, "bone 4 4"],
    ) -> "KinematicTree":
        """Build the tree of shortest paths from the agent's origin over bones that share skin.

        Lengths are squared, so that a leg hangs on the near side of the body. By shared skin alone, or by
        plain length, it may hang on the other leg of its pair, and move with it.
        """
        center = agent_from_bone_rest[:, :3, 3].double().numpy()
        neighbors = joined(shared_skin(weights)).numpy()
        cost = np.zeros((len(center) + 1,) * 2)
        cost[:-1, :-1] = np.where(neighbors, np.square(center[:, None] - center).sum(-1), 0)
        cost[-1, :-1] = DETOUR * np.square(center).sum(-1)
        length, parents = dijkstra(cost, directed=False, indices=-1, return_predecessors=True)
        root = int(cost[-1, :-1].argmin())
        length[root], parents[parents == len(center)], parents[root] = 0, root, root
        order = torch.from_numpy(length[:-1].argsort(kind="stable"))
        parent = torch.from_numpy(parents[:-1]).long()[order]
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
