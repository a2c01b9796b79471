"""3D Gaussians of scene and agent: initialized from meshes, posed by bones, rendered, stored as PLY.

`Gaussians` holds learnable Gaussians; `from_mesh` covers a surface with them; `Splats` holds the room and the
articulated agent; `save_ply` and `load_ply` use the 62 floats a row that every viewer of 3DGS
reads, `load_scene` the room as it stood in one video.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.nn import functional

from pipeline.data import gaussian_ply, npz
from pipeline.fields import rasterize, skinning
from pipeline.geometry import rigid_torch
from pipeline.geometry.meshes import Mesh, area_normals

BAND0 = 0.28209479177387814
"""value of the spherical harmonic of degree 0"""
SIGMA_PER_SPACING = 0.7
"""standard deviation of a surface's Gaussians, in spacings of its points: neighbors overlap"""
INITIAL_OPACITY = 0.9
"""of a surface's Gaussians; nearer to 1 the logit has no gradient"""
OPACITY_MARGIN = 1e-4
"""opacities are kept this far from 0 and 1 for their logit"""
OPACITY = gaussian_ply.COLUMNS.index("opacity")
SCALE = slice(OPACITY + 1, OPACITY + 4)
ROTATION = slice(SCALE.stop, SCALE.stop + 4)
HIGHER_BANDS = sum(name.startswith("f_rest") for name in gaussian_ply.COLUMNS)
"""columns of a file of Gaussians; the higher bands are 0 here"""
THICKEST_M = 0.004
"""maximum thickness of surface Gaussians, so that wide ones do not stick out"""


@dataclass(frozen=True)
class Cloud:
    """Gaussians placed in the world, ready to be drawn."""

    means: Float[Tensor, "point 3"]
    rotation: Float[Tensor, "point 4"]
    log_scale: Float[Tensor, "point 3"]
    opacity: Float[Tensor, "point"]
    color: Float[Tensor, "point 3"]
    agent: Float[Tensor, "point"]
    """1 for the agent's, 0 for the scene's"""


class Gaussians(nn.Module):
    """Gaussians in one frame: the world for the scene, the agent at rest for the agent."""

    def __init__(
        self,
        means: Float[Tensor, "point 3"],
        rotation: Float[Tensor, "point 4"],
        log_scale: Float[Tensor, "point 3"],
        opacity: Float[Tensor, "point"],
        color: Float[Tensor, "point 3"],
    ):
        """``opacity`` and ``color`` lie in 0..1; rotations are quaternions wxyz."""
        super().__init__()
        self.means, self.rotation = nn.Parameter(means), nn.Parameter(rotation)
        self.log_scale = nn.Parameter(log_scale)
        self.opacity_logit = nn.Parameter(torch.logit(opacity.clamp(OPACITY_MARGIN, 1 - OPACITY_MARGIN)))
        self.band0 = nn.Parameter((color - 0.5) / BAND0)

    def __len__(self) -> int:
        return len(self.means)

    @property
    def opacity(self) -> Float[Tensor, "point"]:
        """0..1"""
        return self.opacity_logit.sigmoid()

    @property
    def color(self) -> Float[Tensor, "point 3"]:
        """Red, green, blue, about 0..1."""
        return self.band0 * BAND0 + 0.5

    def cloud(self, which: Int[Tensor, "chosen"] | slice = slice(None)) -> Cloud:
        """Return all or some Gaussians in their own frame."""
        ellipsoids = self.means[which], self.rotation[which], self.log_scale[which]
        opacity = self.opacity_logit[which].sigmoid()
        return Cloud(*ellipsoids, opacity, self.band0[which] * BAND0 + 0.5, torch.zeros_like(opacity))


@dataclass(frozen=True)
class SurfaceSamples:
    """Points spread evenly over a colored surface."""

    points: Float[np.ndarray, "point 3"]
    normal: Float[np.ndarray, "point 3"]
    color: Float[np.ndarray, "point 3"]
    """0..1"""
    spacing_m: float
    """mean distance of neighbors"""


def sample_surface(mesh: Mesh, number: int, rng: np.random.Generator) -> SurfaceSamples:
    """Sample a colored surface uniformly by area (stratified)."""
    assert mesh.color is not None, "the surface has no colors"
    triangle = mesh.vertices[mesh.faces].astype(np.float64)
    normal = area_normals(triangle)
    area = 0.5 * np.linalg.norm(normal, axis=-1)
    cdf = np.cumsum(area) / area.sum()
    face = np.searchsorted(cdf, (np.arange(number) + rng.random()) / number).clip(0, len(area) - 1)
    bary = rng.dirichlet(np.ones(3), number)
    points = np.einsum("pk,pkd->pd", bary, triangle[face])
    color = np.einsum("pk,pkc->pc", bary, mesh.color[mesh.faces[face]] / 255)
    return SurfaceSamples(
        points,
        normal[face] / np.maximum(2 * area[face, None], 1e-12),
        color,
        float(np.sqrt(area.sum() / number)),
    )


def surface_gaussians(
    points: Float[np.ndarray, "point 3"],
    normal: Float[np.ndarray, "point 3"],
    color: Float[np.ndarray, "point 3"],
    spacing_m: float | Float[np.ndarray, "point"],
) -> Gaussians:
    """Place a flat Gaussian at each surface point, scaled by the point spacing; colors in 0..1."""
    wide = np.log(SIGMA_PER_SPACING * np.broadcast_to(spacing_m, len(points)))
    log_scale = np.stack([wide, wide, np.minimum(wide - np.log(5), np.log(THICKEST_M))], axis=-1)
    parts = (
        torch.from_numpy(part).float()
        for part in (points, _facing(normal), log_scale, np.full(len(points), INITIAL_OPACITY), color)
    )
    return Gaussians(*parts)


def from_mesh(mesh: Mesh, number: int, rng: np.random.Generator) -> Gaussians:
    """Cover a colored surface evenly with flat Gaussians."""
    samples = sample_surface(mesh, number, rng)
    return surface_gaussians(samples.points, samples.normal, samples.color, samples.spacing_m)


def _facing(normal: Float[np.ndarray, "point 3"]) -> Float[np.ndarray, "point 4"]:
    """Return the shortest-arc quaternions from the z axis to unit normals."""
    w = 1 + normal[:, 2]
    turned = np.stack([w, -normal[:, 1], normal[:, 0], np.zeros_like(w)], axis=-1)
    turned[w < 1e-6] = [0.0, 1.0, 0.0, 0.0]
    return turned / np.linalg.norm(turned, axis=-1, keepdims=True)


class Splats(nn.Module):
    """The room and the animal as Gaussians, with the bones that move the animal and each video's exposure."""

    agent_weights: Float[Tensor, "point bone"]
    stands: Bool[Tensor, "row point"]
    agent_from_bone_rest: Float[Tensor, "bone 4 4"]

    def __init__(
        self,
        scene: Gaussians,
        agent: Gaussians,
        agent_weights: Float[Tensor, "point bone"],
        agent_from_bone_rest: Float[Tensor, "bone 4 4"],
        videos: int,
        stands: Bool[Tensor, "row point"] | None = None,
    ):
        """``stands``: which Gaussians each video and, last, the shared scene contains; None: all."""
        super().__init__()
        self.scene, self.agent = scene, agent
        self.register_buffer("agent_weights", agent_weights)
        self.register_buffer(
            "stands", torch.ones(videos + 1, len(scene), dtype=torch.bool) if stands is None else stands
        )
        self.register_buffer("agent_from_bone_rest", agent_from_bone_rest)
        self.appearance = nn.Parameter(torch.eye(3, 4).repeat(max(videos, 1), 1, 1))
        """per video: red, green, blue <- matrix @ (red, green, blue, 1)"""

    def place_scene(self, video: int | None, which: Int[Tensor, "chosen"] | None = None) -> Cloud:
        """Return the room, or some of its Gaussians, in one video (None: the shared scene)."""
        here = self.stands[-1 if video is None else video]
        which = torch.nonzero(here)[:, 0] if which is None else which[here[which]]
        return self._exposed(self.scene.cloud(which), video)

    def place_agent(
        self,
        world_from_agent: Float[Tensor, "4 4"],
        agent_from_bone: Float[Tensor, "bone 4 4"],
        video: int | None,
    ) -> Cloud:
        """Return the animal in one pose, with the exposure of one video."""
        agent = self.agent.cloud()
        agent_from_rest = skinning.blend(self.agent_weights, agent_from_bone, self.agent_from_bone_rest)
        heading = rigid_torch.quaternion_from_rotation(world_from_agent[:3, :3])
        turn = skinning.multiply_quaternions(heading, agent_from_rest[:4].T)
        rotation = skinning.multiply_quaternions(turn, functional.normalize(agent.rotation, dim=-1))
        posed = replace(
            agent,
            means=rigid_torch.apply(world_from_agent, skinning.move(agent_from_rest, agent.means)),
            rotation=rotation,
            agent=torch.ones_like(agent.opacity),
        )
        return self._exposed(posed, video)

    def _exposed(self, cloud: Cloud, video: int | None) -> Cloud:
        if video is None:
            return cloud
        matrix = self.appearance[video]
        return replace(cloud, color=cloud.color @ matrix[:, :3].T + matrix[:, 3])


def concatenate(*clouds: Cloud) -> Cloud:
    """Concatenate clouds."""
    return Cloud(
        *(torch.cat([getattr(cloud, name) for cloud in clouds]) for name in Cloud.__dataclass_fields__)
    )


@dataclass(frozen=True)
class RenderedCloud:
    """A rendered cloud."""

    color: Float[Tensor, "height width 3"]
    """over black"""
    depth: Float[Tensor, "height width"]
    """mean z, normalized by coverage, meters"""
    agent: Float[Tensor, "height width"]
    coverage: Float[Tensor, "height width"]
    extra: Float[Tensor, "height width channel"]


def render(
    cloud: Cloud, camera_from_world: Float[Tensor, "4 4"], intrinsics: Float[Tensor, "3 3"],
    height: int, width: int,
    backend: rasterize.Backend = "tiles", extra: Float[Tensor, "point channel"] | None = None,
) -> RenderedCloud:  # fmt: skip
    """Draw a cloud: color, depth, the agent's share, and any further values per Gaussian."""
    depth = cloud.means @ camera_from_world[2, :3] + camera_from_world[2, 3]
    values = [cloud.color, depth[:, None], cloud.agent[:, None]] + ([] if extra is None else [extra])
    ellipsoids, camera = (cloud.means, cloud.rotation, cloud.log_scale), (camera_from_world, intrinsics)
    image, coverage = rasterize.draw(
        *ellipsoids, cloud.opacity, torch.cat(values, dim=-1), *camera, height, width, backend
    )
    return RenderedCloud(
        image[..., :3], image[..., 3] / coverage.clamp_min(1e-3), image[..., 4], coverage, image[..., 5:]
    )


def save_ply(path: Path, gaussians: Gaussians, which: Bool[Tensor, "point"]) -> None:
    """Write some Gaussians as a standard 3DGS PLY; exclude those that are not `drawable`."""
    with torch.no_grad():
        rotation = functional.normalize(gaussians.rotation, dim=-1)
        rest = torch.zeros(len(gaussians), HIGHER_BANDS, device=rotation.device)
        normals = torch.zeros_like(gaussians.means)
        columns = (
            gaussians.means, normals, gaussians.band0, rest,
            gaussians.opacity_logit[:, None], gaussians.log_scale, rotation,
        )  # fmt: skip
        table = torch.cat(columns, dim=-1)
    gaussian_ply.write(path, table[which].cpu().numpy())


@torch.no_grad()
def drawable(gaussians: Gaussians) -> Bool[Tensor, "point"]:
    """Return which Gaussians are finite and have an opacity of at least 1/255."""
    columns = torch.cat([each.reshape(len(gaussians), -1) for each in gaussians.parameters()], dim=-1)
    return columns.isfinite().all(-1) & (gaussians.opacity >= 1 / 255)


def load_ply(path: Path) -> Gaussians:
    """Read what `save_ply` wrote. Raises `InputError` ART-021 for any other file."""
    table = torch.from_numpy(gaussian_ply.read(path).copy())
    return Gaussians(
        table[:, :3],
        table[:, ROTATION],
        table[:, SCALE],
        table[:, OPACITY].sigmoid(),
        table[:, 6:9] * BAND0 + 0.5,
    )


def load_scene(splats: Path, video: str) -> Gaussians:
    """Read the room as it stood in one video from the artifact `splats`."""
    parts = [load_ply(splats / f"{name}.ply") for name in ("scene", "moved")]
    table = npz.load(splats / "splats.npz", ("videos", "stands"))
    here = torch.from_numpy(table["stands"][table["videos"].tolist().index(video)])
    names = ("means", "rotation", "log_scale", "opacity", "color")
    return Gaussians(*(torch.cat([getattr(part, name) for part in parts]).detach()[here] for name in names))
