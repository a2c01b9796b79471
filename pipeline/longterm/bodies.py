"""Skinned bodies and their pose space.

`SkinnedBody` is an animal's surface at rest with skinning weights. `PosedSurface` poses it by linear blend
skinning in torch. `PoseSpace` encodes the bones of a frame as a code p, like the paper's SMPL-X body prior.
Poses are bones in the agent frame; `pipeline.behavior.model.channels_from_bones` returns their channels.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from pipeline.behavior.model import channels_from_bones
from pipeline.data import ply
from pipeline.data.templates import SKIN
from pipeline.geometry import rigid, rigid_torch, subsampling
from pipeline.geometry.meshes import Mesh

LEVER_M = 0.1
"""Length that converts bone rotations in radians to meters in the pose space."""


@dataclass(frozen=True)
class SkinnedBody:
    """A skinned surface at rest, agent frame, meters."""

    mesh: Mesh
    weights: Float[np.ndarray, "vertex bone"]
    agent_from_bone_rest: Float[np.ndarray, "bone 4 4"]
    shape: Float[np.ndarray, "channel"]
    """shape code (betas of SMPL-X); empty for a single animal"""

    @property
    def length_m(self) -> float:
        """Longest side of the bounding box at rest."""
        return float(np.ptp(self.mesh.vertices, axis=0).max())

    def sample_vertices(self, count: int) -> Int[np.ndarray, "vertex"]:
        """Choose vertices by farthest point sampling, starting from the first vertex."""
        return subsampling.farthest_points(np.asarray(self.mesh.vertices, np.float64), count, 0)


def load_body(reconstruction: Path) -> SkinnedBody:
    """Read the reconstructed animal: `agent.ply` and `skin.npz`. Raises InputError if they are damaged."""
    skin = SKIN.load(reconstruction / "skin.npz", "weights", "agent_from_bone_rest")
    mesh, rest = ply.read_ply(reconstruction / "agent.ply"), skin["agent_from_bone_rest"].astype(np.float64)
    return SkinnedBody(mesh, skin["weights"], rest, np.zeros(0))


class PosedSurface(nn.Module):
    """Linear blend skinning of some vertices of a body, one matrix product for all frames."""

    blend: Float[Tensor, "vertex bone_column"]

    def __init__(self, body: SkinnedBody, vertices: Int[np.ndarray, "vertex"] | None = None):
        super().__init__()
        index = np.arange(len(body.mesh.vertices)) if vertices is None else vertices
        vertices_agent = np.asarray(body.mesh.vertices, np.float64)[index]
        in_bone = rigid.apply(rigid.inverse(body.agent_from_bone_rest), vertices_agent)  # bone vertex 3
        homogeneous = np.concatenate([in_bone, np.ones_like(in_bone[..., :1])], axis=-1)
        blend = np.einsum("vb,bvk->vbk", body.weights[index], homogeneous).reshape(len(index), -1)
        self.register_buffer("blend", torch.from_numpy(blend).float(), persistent=False)

    def forward(
        self, world_from_agent: Float[Tensor, "frame 4 4"], agent_from_bone: Float[Tensor, "frame bone 4 4"]
    ) -> Float[Tensor, "frame vertex 3"]:
        """Return the posed vertices in the world."""
        world_from_bone = (world_from_agent[:, None] @ agent_from_bone)[..., :3, :]
        columns = world_from_bone.permute(1, 3, 0, 2).reshape(self.blend.shape[1], -1)  # bone*4 frame*3
        return (self.blend @ columns).unflatten(1, (-1, 3)).transpose(0, 1)


class PoseSpace(nn.Module):
    """Pose codes p: whitened principal components of the bones' channels."""

    rest: Float[Tensor, "bone 4 4"]
    mean: Float[Tensor, "channel"]
    basis: Float[Tensor, "component channel"]
    inverse: Float[Tensor, "channel component"]
    explained: Float[Tensor, ""]

    def __init__(self, agent_from_bone_rest: Float[np.ndarray, "bone 4 4"], components: int):
        super().__init__()
        channels = 6 * len(agent_from_bone_rest)
        self.register_buffer("rest", torch.from_numpy(np.asarray(agent_from_bone_rest)).float())
        self.register_buffer("mean", torch.zeros(channels))
        self.register_buffer("basis", torch.zeros(components, channels))
        self.register_buffer("inverse", torch.zeros(channels, components))
        self.register_buffer("explained", torch.zeros(()))

    def fit(self, agent_from_bone: Float[np.ndarray, "frame bone 4 4"]) -> "PoseSpace":
        """Fit mean and components to poses; returns itself."""
        channels = channels_from_bones(agent_from_bone, self.rest.double().numpy())
        scale = np.tile([LEVER_M] * 3 + [1.0] * 3, agent_from_bone.shape[1])
        mean = channels.mean(0)
        _, singular, rows = np.linalg.svd((channels - mean) * scale, full_matrices=False)
        retained = min(len(self.basis), len(singular))
        std = np.maximum(singular[:retained] / np.sqrt(len(channels)), 1e-6)
        rows = rows * np.sign(rows[np.arange(len(rows)), np.abs(rows).argmax(1)])[:, None]
        self.mean[:] = torch.from_numpy(mean)
        self.basis[:retained] = torch.from_numpy(rows[:retained] * std[:, None] / scale)
        self.inverse[:, :retained] = torch.from_numpy((rows[:retained] / std[:, None]).T * scale[:, None])
        self.explained.fill_(float((singular[:retained] ** 2).sum() / (singular**2).sum()))
        return self

    def channels(
        self, agent_from_bone: Float[np.ndarray, "*batch bone 4 4"]
    ) -> Float[Tensor, "*batch channel"]:
        """Return the channels of bones, radians and meters."""
        bones, rest = np.asarray(agent_from_bone, np.float64), self.rest.double().numpy()
        return torch.from_numpy(channels_from_bones(bones, rest)).float()

    def encode(self, channels: Float[Tensor, "*batch channel"]) -> Float[Tensor, "*batch component"]:
        """Encode channels of bones as p."""
        return (channels - self.mean) @ self.inverse

    def decode(self, p: Float[Tensor, "*batch component"]) -> Float[Tensor, "*batch channel"]:
        """Decode p to channels of bones."""
        return self.mean + p @ self.basis

    def bones(self, channels: Float[Tensor, "*batch channel"]) -> Float[Tensor, "*batch bone 4 4"]:
        """Return `agent_from_bone` of channels."""
        twist = channels.unflatten(-1, (len(self.rest), 6))
        turn = rigid_torch.so3_exp(twist[..., :3])
        return rigid_torch.make(turn @ self.rest[:, :3, :3], self.rest[:, :3, 3] + twist[..., 3:])
