"""Rendering of a reconstruction.

`composite` is the differentiable renderer of the paper (A.1): densities of scene and agent add, their colors
and features mix by density; `importance_depths` places samples where a first pass found density.
`render_depth` renders depth pictures from the fields that way. `Renderer` draws pictures fast: rays meet the
extracted surfaces (scene with one video's code, posed agent) and the fields give the color there.
"""

from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Generator, Tensor

from pipeline.fields import marching_cubes
from pipeline.fields.fields import Field, Reconstruction, Values
from pipeline.geometry import cameras, rigid_torch
from pipeline.geometry.meshes import Mesh, RayCaster

MIN_OPACITY = 0.5
"""rendered depth is known where the fields are at least this opaque"""
MIN_DIVISOR = 1e-4
"""lower bound of the opacity that depth is divided by"""
RAYS_AT_ONCE = 4096
"""rays rendered together, for memory"""
NEAREST_M = 0.1
"""rendered rays begin here"""
UNIFORM_WEIGHT = 1e-5
"""added to the weights of importance sampling, so that empty rays are sampled uniformly"""


@dataclass(frozen=True)
class Layer:
    """One field's density, color and features at samples along rays."""

    density: Float[Tensor, "ray sample"]
    """per meter"""
    color: Float[Tensor, "ray sample 3"]
    feature: Float[Tensor, "ray sample 16"]

    @classmethod
    def of(cls, field: Field, values: Values, shape: tuple[int, ...], min_beta_m: float = 0.0) -> "Layer":
        """Reshape a field's values at samples; for ``min_beta_m`` see `Field.density`."""
        density = field.density(values.signed_distance, min_beta_m).view(shape)
        return cls(density, values.color.view(*shape, 3), values.feature.view(*shape, -1))

    @classmethod
    def of_agent(
        cls, field: Field, rest: Float[Tensor, "*batch 3"], shape: tuple[int, ...], min_beta_m: float = 0.0
    ) -> "Layer":
        """Evaluate the agent's field at samples in the rest shape; it is empty outside its box."""
        low, high = (rest.new_tensor(corner) for corner in (field.shape.low_m, field.shape.high_m))
        inside = ((rest > low) & (rest < high)).all(-1).view(shape)
        layer = cls.of(field, field(rest.reshape(-1, 3)), shape, min_beta_m)
        return replace(layer, density=layer.density * inside)


@dataclass(frozen=True)
class Rendered:
    """Composited values of rays."""

    color: Float[Tensor, "ray 3"]
    feature: Float[Tensor, "ray 16"]
    depth: Float[Tensor, "ray"]
    """expected z in meters, normalized by opacity"""
    agent: Float[Tensor, "ray"]
    """opacity of the agent, 0..1"""
    opacity: Float[Tensor, "ray"]
    weight: Float[Tensor, "ray sample"]
    """of each sample in the sums above"""
    agent_share: Float[Tensor, "ray sample"]
    """share of the agent in each sample's density"""


def ray_weights(
    depth_m: Float[Tensor, "ray sample"], length: Float[Tensor, "ray"], density: Float[Tensor, "ray sample"]
) -> Float[Tensor, "ray sample"]:
    """Return the weight of each sample in the rendering integral (ATS, Eq. 15); arguments as
    `composite`'s.

    Each sample represents the interval up to halfway to its neighbors.
    """
    optical_depth = density * _interval_edges(depth_m).diff(dim=-1) * length[:, None]
    return torch.exp(-(optical_depth.cumsum(-1) - optical_depth)) * (1 - torch.exp(-optical_depth))


def _interval_edges(depth_m: Float[Tensor, "ray sample"]) -> Float[Tensor, "ray end"]:
    """Return the boundaries of the intervals that the samples of a ray represent."""
    half = depth_m.diff(dim=-1) / 2
    middle = depth_m[:, :-1] + half
    return torch.cat([depth_m[:, :1] - half[:, :1], middle, depth_m[:, -1:] + half[:, -1:]], dim=-1)


def importance_depths(
    depth_m: Float[Tensor, "ray sample"],
    length: Float[Tensor, "ray"],
    density: Float[Tensor, "ray sample"],
    generator: Generator | None = None,
) -> Float[Tensor, "ray sample"]:
    """Draw as many more samples, z in meters, from the weights of a coarse pass (NeRF, Mildenhall et al.
    2020, Sec. 5.2).

    Stratified with a ``generator``, else at the middle of each stratum.
    """
    weight = ray_weights(depth_m, length, density) + UNIFORM_WEIGHT
    cdf = torch.nn.functional.pad((weight / weight.sum(-1, keepdim=True)).cumsum(-1), (1, 0))
    edges, count = _interval_edges(depth_m), depth_m.shape[1]
    offset = (
        torch.full(depth_m.shape, 0.5)
        if generator is None
        else torch.rand(depth_m.shape, generator=generator)
    )
    uniform = (torch.arange(count, device=depth_m.device) + offset.to(depth_m.device)) / count
    after = torch.searchsorted(cdf, uniform.contiguous(), right=True).clamp(1, count)
    low, high = cdf.gather(1, after - 1), cdf.gather(1, after)
    fraction = ((uniform - low) / (high - low).clamp_min(UNIFORM_WEIGHT / count)).clamp(0, 1)
    return torch.lerp(edges.gather(1, after - 1), edges.gather(1, after), fraction)


def composite(
    depth_m: Float[Tensor, "ray sample"],
    length: Float[Tensor, "ray"],
    scene: Layer,
    agent: Layer | None = None,
) -> Rendered:
    """Integrate the fields of scene and agent along rays (ATS, Eqs. 14-15).

    Args:
        depth_m: z of the samples, increasing.
        length: meters along each ray per meter of z.
        agent: None where there is none.
    """
    density, color, feature = scene.density, scene.color, scene.feature
    share = torch.zeros_like(density)
    if agent is not None:
        density = density + agent.density
        share = agent.density / density.clamp_min(1e-8)
        color = color + share[..., None] * (agent.color - color)
        feature = feature + share[..., None] * (agent.feature - feature)
    weight = ray_weights(depth_m, length, density)
    opacity = weight.sum(-1)
    depth = (weight * depth_m).sum(-1) / opacity.clamp_min(MIN_DIVISOR)
    color, feature = ((weight[..., None] * values).sum(-2) for values in (color, feature))
    return Rendered(color, feature, depth, (weight * share).sum(-1), opacity, weight, share)


@torch.no_grad()
def render_depth(
    reconstruction: Reconstruction,
    world_from_camera: Float[np.ndarray, "4 4"],
    intrinsics: Float[np.ndarray, "3 3"],
    height: int,
    width: int,
    farthest_m: float,
    video: str | None = None,
    world_from_agent: Float[np.ndarray, "4 4"] | None = None,
    agent_from_bone: Float[np.ndarray, "bone 4 4"] | None = None,
    samples: int = 128,
) -> tuple[Float[np.ndarray, "height width"], Float[np.ndarray, "height width"]]:
    """Render depth from the fields by volume rendering, as DepthAcc of the paper is measured (ATS,
    A.1).

    Unlike `Renderer`, no surface is extracted: even samples up to ``farthest_m`` along z and as many
    importance samples are composited. Without the agent's pose the scene alone is rendered.

    Returns:
        Expected z in meters (0 where the fields are less opaque than `MIN_OPACITY`), and the agent's
        opacity, 0..1.
    """
    device = reconstruction.scene.log_beta.device
    code = reconstruction.video_code(video)

    def tensor(array: np.ndarray) -> Tensor:
        return torch.as_tensor(array, dtype=torch.float32, device=device)

    pose = tensor(world_from_camera)
    directions = tensor(cameras.ray_directions(intrinsics, height, width).reshape(-1, 3))
    spacing = (farthest_m - NEAREST_M) / (samples // 2)
    uniform = NEAREST_M + spacing * (torch.arange(samples // 2, device=device) + 0.5)
    agent_pose = None
    if world_from_agent is not None and agent_from_bone is not None:
        agent_pose = rigid_torch.inverse(tensor(world_from_agent)) @ pose, tensor(agent_from_bone)
    depths, agents = [], []
    for direction in directions.split(RAYS_AT_ONCE):
        rays = _PosedRays(reconstruction, pose, direction, code, agent_pose)
        length, depth = direction.norm(dim=-1), uniform.expand(len(direction), -1)
        scene, agent = rays.layers(depth, spacing / 2)
        total = scene.density if agent is None else scene.density + agent.density
        fine = importance_depths(depth, length, total)
        depth = torch.cat([depth, fine], dim=1).sort(dim=1).values
        rendered = composite(depth, length, *rays.layers(depth))
        depths.append(torch.where(rendered.opacity >= MIN_OPACITY, rendered.depth, 0))
        agents.append(rendered.agent)
    depth_map, agent_map = (torch.cat(part).view(height, width).cpu().numpy() for part in (depths, agents))
    return depth_map, agent_map


@dataclass(frozen=True)
class _PosedRays:
    """Rays of a camera through scene and posed agent."""

    reconstruction: Reconstruction
    world_from_camera: Float[Tensor, "4 4"]
    direction: Float[Tensor, "ray 3"]
    """camera frame, z = 1"""
    code: int
    agent_pose: tuple[Float[Tensor, "4 4"], Float[Tensor, "bone 4 4"]] | None
    """agent from camera, and agent from bones"""

    def layers(
        self, depth: Float[Tensor, "ray sample"], min_beta_m: float = 0.0
    ) -> tuple[Layer, Layer | None]:
        """Evaluate scene and posed agent at samples, z in meters; `Field.density` explains the least beta."""
        scene, agent, body = self.reconstruction.scene, self.reconstruction.agent, self.reconstruction.body
        points_camera = (self.direction[:, None] * depth[..., None]).reshape(-1, 3)
        world = rigid_torch.apply(self.world_from_camera, points_camera)
        values = scene(world, torch.full((len(world),), self.code, device=world.device))
        scene_layer = Layer.of(scene, values, depth.shape, min_beta_m)
        if self.agent_pose is None:
            return scene_layer, None
        agent_from_camera, bones = self.agent_pose
        rest = body.unpose(rigid_torch.apply(agent_from_camera, points_camera)[None], bones[None])[0]
        return scene_layer, Layer.of_agent(agent, rest, depth.shape, min_beta_m)


@dataclass(frozen=True)
class DrawnView:
    """One drawn view."""

    color: UInt8[np.ndarray, "height width 3"]
    depth: Float[np.ndarray, "height width"]
    """meters along z; 0 = nothing there"""
    agent: Bool[np.ndarray, "height width"]
    """the agent is in front"""


class Renderer:
    """Draws views of a reconstruction as one video saw it; build once per video, draw often."""

    def __init__(
        self, reconstruction: Reconstruction, video: str | None = None, agent_step_m: float = 0.0075
    ):
        """``video``: the scene's code (None: the shared scene); the step is that of the agent's mesh."""
        self.reconstruction = reconstruction
        self.code = reconstruction.video_code(video)
        self.device = reconstruction.scene.log_beta.device
        self.scene_caster = RayCaster(
            marching_cubes.extract_scene(reconstruction.scene, self.code, reconstruction.scene.lattice_m)
        )
        self.agent_mesh = marching_cubes.extract_agent(reconstruction.agent, agent_step_m)
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
    ) -> DrawnView:
        """Draw color, depth and the agent's mask; without the agent's pose, the scene alone."""
        directions = (
            cameras.ray_directions(intrinsics, height, width).reshape(-1, 3) @ world_from_camera[:3, :3].T
        )
        origin = world_from_camera[:3, 3]
        hits = self.scene_caster.cast(origin, directions)
        depth, is_agent = np.array(hits.distance), np.zeros(len(directions), bool)
        if world_from_agent is not None and agent_from_bone is not None:
            mesh = self.posed(world_from_agent, agent_from_bone)
            agent_hits = RayCaster(mesh).cast(origin, directions)
            is_agent = agent_hits.distance < depth
            depth[is_agent] = agent_hits.distance[is_agent]
        color = np.zeros((len(depth), 3), np.float32)
        on_scene = np.isfinite(depth) & ~is_agent
        color[on_scene] = self._scene_color(origin + directions[on_scene] * depth[on_scene, None])
        if is_agent.any():
            rest = torch.from_numpy(agent_hits.interpolate(mesh, self.agent_mesh.vertices)[is_agent])
            field = self.reconstruction.agent
            color[is_agent] = field.color_and_feature(field.encode(rest.to(self.device)))[0].cpu().numpy()
        shape = (height, width)
        depth = np.where(np.isfinite(depth), depth, 0).astype(np.float32)
        return DrawnView(
            (color * 255 + 0.5).astype(np.uint8).reshape(*shape, 3),
            depth.reshape(shape),
            is_agent.reshape(shape),
        )

    @torch.no_grad()
    def posed(
        self, world_from_agent: Float[np.ndarray, "4 4"], agent_from_bone: Float[np.ndarray, "bone 4 4"]
    ) -> Mesh:
        """Return the agent's surface in the world."""
        bones = torch.as_tensor(agent_from_bone, dtype=torch.float32, device=self.device)
        posed = self.reconstruction.body.pose(self._rest, bones).cpu().numpy()
        world = posed @ world_from_agent[:3, :3].T + world_from_agent[:3, 3]
        return Mesh(world.astype(np.float32), self.agent_mesh.faces, self.agent_mesh.color)

    def _scene_color(self, points_world: Float[np.ndarray, "point 3"]) -> Float[np.ndarray, "point 3"]:
        field = self.reconstruction.scene
        points = torch.from_numpy(points_world.astype(np.float32)).to(self.device)
        video = torch.full((len(points),), self.code, device=self.device)
        return field.color_and_feature(field.encode(points, video))[0].cpu().numpy()
