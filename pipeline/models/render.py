"""Two ways to see a reconstruction.

`composite` is the differentiable renderer of the paper (A.1): densities of scene and agent add, their colours and
features mix by density. `Renderer` draws pictures fast: rays meet the extracted surfaces (scene with one video's
code, posed agent) and the fields give the colour there.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from pipeline.models import surfaces
from pipeline.models.fields import Reconstruction
from pipeline.space import cameras
from pipeline.space.meshes import Mesh, RayCaster


@dataclass(frozen=True)
class Layer:
    """What one field gives along rays."""

    density: Float[Tensor, "ray sample"]
    """per metre"""
    color: Float[Tensor, "ray sample 3"]
    feature: Float[Tensor, "ray sample 16"]


@dataclass(frozen=True)
class Rendered:
    """What rays see."""

    color: Float[Tensor, "ray 3"]
    feature: Float[Tensor, "ray 16"]
    depth: Float[Tensor, "ray"]
    """expected z in metres over what is hit"""
    agent: Float[Tensor, "ray"]
    """opacity of the agent, 0..1"""
    opacity: Float[Tensor, "ray"]
    weight: Float[Tensor, "ray sample"]
    """of each sample in the sums above"""
    agent_share: Float[Tensor, "ray sample"]
    """of the agent in each sample's density"""


def composite(depth_m: Float[Tensor, "ray sample"], length: Float[Tensor, "ray"], scene: Layer, agent: Layer) -> Rendered:
    """Integrate two fields along rays (paper 001, Eqs. 14-15).

    Args:
        depth_m: z of the samples, increasing.
        length: metres along each ray per metre of z.
    """
    density = scene.density + agent.density
    share = agent.density / density.clamp_min(1e-8)
    step = torch.diff(depth_m, dim=-1)
    step = torch.cat([step, step[:, -1:]], dim=-1) * length[:, None]
    optical = density * step
    through = torch.exp(-(optical.cumsum(-1) - optical))
    weight = through * (1 - torch.exp(-optical))
    opacity = weight.sum(-1)
    color = scene.color + share[..., None] * (agent.color - scene.color)
    feature = scene.feature + share[..., None] * (agent.feature - scene.feature)
    depth = (weight * depth_m).sum(-1) / opacity.clamp_min(1e-4)
    mixed = [(weight[..., None] * values).sum(-2) for values in (color, feature)]
    return Rendered(*mixed, depth, (weight * share).sum(-1), opacity, weight, share)


@dataclass(frozen=True)
class Picture:
    """One drawn view."""

    color: UInt8[np.ndarray, "height width 3"]
    depth: Float[np.ndarray, "height width"]
    """metres along z; 0 = nothing there"""
    agent: Bool[np.ndarray, "height width"]
    """the agent is in front"""


class Renderer:
    """Draws views of a reconstruction as one video saw it; build once per video, draw often."""

    def __init__(self, reconstruction: Reconstruction, video: str | None = None, agent_step_m: float = 0.0075):
        """``video`` chooses the scene's code (None: the shared scene); the step is the resolution of the agent's mesh."""
        self.reconstruction = reconstruction
        self.code = reconstruction.video_code(video)
        self.device = reconstruction.scene.log_beta.device
        self.scene_caster = RayCaster(surfaces.extract_scene(reconstruction.scene, self.code, reconstruction.scene.lattice_m))
        self.agent_mesh = surfaces.extract_agent(reconstruction.agent, agent_step_m)
        self._rest = torch.from_numpy(self.agent_mesh.vertices).to(self.device)

    @torch.no_grad()
    def draw(
        self,
        world_from_camera: Float[np.ndarray, "4 4"],
        intrinsics: Float[np.ndarray, "3 3"],
        height: int,
        width: int,
        world_from_agent: Float[np.ndarray, "4 4"] | None = None,
        agent_from_bone: Float[np.ndarray, "bone 4 4"] | None = None,
    ) -> Picture:
        """Draw colour, depth and the agent's mask; without the agent's pose, the scene alone."""
        directions = cameras.ray_directions(intrinsics, height, width).reshape(-1, 3) @ world_from_camera[:3, :3].T
        origin = world_from_camera[:3, 3]
        hits = self.scene_caster.cast(origin, directions)
        depth, is_agent = np.array(hits.distance), np.zeros(len(directions), bool)
        if world_from_agent is not None:
            mesh = self.posed(world_from_agent, agent_from_bone)
            agent_hits = RayCaster(mesh).cast(origin, directions)
            is_agent = agent_hits.distance < depth
            depth[is_agent] = agent_hits.distance[is_agent]
        color = np.zeros((len(depth), 3), np.float32)
        on_scene = np.isfinite(depth) & ~is_agent
        color[on_scene] = self._scene_color(origin + directions[on_scene] * depth[on_scene, None])
        if is_agent.any():
            rest = agent_hits.interpolate(mesh, self.agent_mesh.vertices)[is_agent]
            field = self.reconstruction.agent
            color[is_agent] = field.look(field.encode(torch.from_numpy(rest).to(self.device)))[0].cpu().numpy()
        shape = (height, width)
        depth = np.where(np.isfinite(depth), depth, 0).astype(np.float32)
        return Picture((color * 255 + 0.5).astype(np.uint8).reshape(*shape, 3), depth.reshape(shape), is_agent.reshape(shape))

    @torch.no_grad()
    def posed(self, world_from_agent: Float[np.ndarray, "4 4"], agent_from_bone: Float[np.ndarray, "bone 4 4"]) -> Mesh:
        """Return the agent's surface in the world."""
        bones = torch.as_tensor(agent_from_bone, dtype=torch.float32, device=self.device)
        posed = self.reconstruction.body.pose(self._rest, bones).cpu().numpy()
        world = posed @ world_from_agent[:3, :3].T + world_from_agent[:3, 3]
        return Mesh(world.astype(np.float32), self.agent_mesh.faces, self.agent_mesh.color)

    def _scene_color(self, points_world: Float[np.ndarray, "point 3"]) -> Float[np.ndarray, "point 3"]:
        field = self.reconstruction.scene
        points = torch.from_numpy(points_world.astype(np.float32)).to(self.device)
        video = torch.full((len(points),), self.code, device=self.device)
        return field.look(field.encode(points, video))[0].cpu().numpy()
