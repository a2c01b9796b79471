"""Skinning of the agent: weights of Gaussian bones and dual-quaternion blending.

`skinning_weights` gives the probability of each bone for each point (Gaussian bones, softmax over the
negative squared Mahalanobis distance); `blend` mixes the bones' motions by dual quaternions; `move` applies
the result; `SkinnedShape.posed` does both for NumPy arrays. Forward (rest to posed) uses the weights at rest.
Backward uses the same weights evaluated with the posed bones at the posed points, and the inverse of the
blended motion (Yang et al., BANMo, Eqs. 4-7).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.nn import functional

from pipeline.geometry import rigid_torch


def squared_mahalanobis(
    points_agent: Float[Tensor, "*#batch point 3"],
    agent_from_bone: Float[Tensor, "*#batch bone 4 4"],
    bone_scale_m: Float[Tensor, "bone 3"],
) -> Float[Tensor, "*#batch point bone"]:
    """Return the squared Mahalanobis distance of each point from each Gaussian bone.

    Each distance is the quadric p' Q p of the homogeneous point p: one matrix product for all points and
    bones.
    """
    inverse_scale = torch.cat([1 / bone_scale_m, torch.zeros_like(bone_scale_m[:, :1])], dim=-1)
    scaled = inverse_scale[:, :, None] * rigid_torch.inverse(agent_from_bone)
    quadric = (scaled.transpose(-1, -2) @ scaled).flatten(-2)
    homogeneous = functional.pad(points_agent, (0, 1), value=1.0)
    products = (homogeneous[..., :, None] * homogeneous[..., None, :]).flatten(-2)
    return (products @ quadric.transpose(-1, -2)).clamp_min(0)


def skinning_weights(
    points_agent: Float[Tensor, "*#batch point 3"],
    agent_from_bone_rest: Float[Tensor, "*#batch bone 4 4"],
    bone_scale_m: Float[Tensor, "bone 3"],
    delta: Float[Tensor, "*#batch point bone"] | None = None,
) -> Float[Tensor, "*#batch point bone"]:
    """Return the probability of each bone for each point (ATS, Sec. 3.1).

    Args:
        points_agent: points in the agent frame, in meters.
        agent_from_bone_rest: bones at rest, or posed bones when the points are posed.
        bone_scale_m: standard deviations of the Gaussian bones along their own axes.
        delta: learned correction, added to the logits.
    """
    logits = -squared_mahalanobis(points_agent, agent_from_bone_rest, bone_scale_m)
    return (logits if delta is None else logits + delta).softmax(-1)


def multiply_quaternions(
    first: Float[Tensor, "*#batch 4"], second: Float[Tensor, "*#batch 4"]
) -> Float[Tensor, "*#batch 4"]:
    """Multiply quaternions wxyz (Hamilton product); leading axes broadcast."""
    w, vector, scalar, other = first[..., :1], first[..., 1:], second[..., :1], second[..., 1:]
    vector, other = torch.broadcast_tensors(vector, other)
    real = w * scalar - (vector * other).sum(-1, keepdim=True)
    return torch.cat([real, w * other + scalar * vector + torch.linalg.cross(vector, other)], dim=-1)


def blend(
    weights: Float[Tensor, "*#batch point bone"],
    agent_from_bone: Float[Tensor, "*#batch bone 4 4"],
    agent_from_bone_rest: Float[Tensor, "bone 4 4"],
) -> Float[Tensor, "*#batch 8 point"]:
    """Blend bone motions into one rigid motion a point, by dual quaternions (Kavan et al. 2007, Sec. 3).

    Leading axes broadcast: `weights [point bone]` with `agent_from_bone [frame bone 4 4]` gives
    `[frame 8 point]`. Quaternions are turned to the hemisphere of each point's strongest bone.

    Returns:
        `agent_from_rest`: takes points of the rest shape to the posed shape, both in the agent frame; the
        unit quaternion wxyz and the dual one.
    """
    motion = agent_from_bone @ rigid_torch.inverse(agent_from_bone_rest)
    real = rigid_torch.quaternion_from_rotation(motion[..., :3, :3])
    dual = 0.5 * multiply_quaternions(functional.pad(motion[..., :3, 3], (1, 0)), real)
    with torch.no_grad():
        opposite = real @ real.transpose(-1, -2) < 0
        strongest = weights.argmax(-1) if opposite.any() else None
    if strongest is not None:
        shape = torch.broadcast_shapes(strongest.shape[:-1], opposite.shape[:-2])
        index = strongest.expand(*shape, -1)[..., None].expand(*shape, -1, opposite.shape[-1])
        weights = torch.where(opposite.expand(*shape, -1, -1).gather(-2, index), -weights, weights)
    both = torch.cat([real, dual], dim=-1).transpose(-1, -2) @ weights.transpose(-1, -2)
    return both / both[..., :4, :].norm(dim=-2, keepdim=True)


def move(
    target_from_source: Float[Tensor, "*#batch 8 point"],
    points: Float[Tensor, "*#batch point 3"],
    inverse: bool = False,
) -> Float[Tensor, "*#batch point 3"]:
    """Apply one motion of `blend` a point, or its inverse with ``inverse``, meters.

    Component by component: PyTorch takes several times longer over axes of length 3.
    """
    w, *turn, dual_w, x, y, z = target_from_source.unbind(-2)
    dual, place = (x, y, z), list(points.unbind(-1))
    shift = [2 * (w * d - dual_w * t + c) for d, t, c in zip(dual, turn, _cross(turn, dual), strict=True)]
    if inverse:
        w, place = -w, [p - s for p, s in zip(place, shift, strict=True)]
    inner = [c + w * p for c, p in zip(_cross(turn, place), place, strict=True)]
    moved = torch.stack([p + 2 * c for p, c in zip(place, _cross(turn, inner), strict=True)], dim=-1)
    return moved if inverse else moved + torch.stack(shift, dim=-1)


@dataclass(frozen=True)
class SkinnedShape:
    """A surface at rest with its skinning weights and bones; agent frame, meters."""

    vertices: Float[np.ndarray, "vertex 3"]
    weights: Float[np.ndarray, "vertex bone"]
    agent_from_bone_rest: Float[np.ndarray, "bone 4 4"]

    def posed(self, agent_from_bone: Float[np.ndarray, "bone 4 4"]) -> Float[np.ndarray, "vertex 3"]:
        """Return the vertices posed by dual-quaternion blending, computed in single precision."""
        weights, bones, rest, points = (
            torch.as_tensor(np.ascontiguousarray(part, np.float32))
            for part in (self.weights, agent_from_bone, self.agent_from_bone_rest, self.vertices)
        )
        return move(blend(weights, bones, rest), points).numpy().astype(np.float64)

    def only(self, index: Int[np.ndarray, "chosen"]) -> "SkinnedShape":
        """Return some of the vertices."""
        return SkinnedShape(self.vertices[index], self.weights[index], self.agent_from_bone_rest)


def _cross(a: Sequence[Tensor], b: Sequence[Tensor]) -> list[Tensor]:
    return [a[k - 2] * b[k - 1] - a[k - 1] * b[k - 2] for k in range(3)]
