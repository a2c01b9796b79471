"""The canonical structure T: neural fields of the scene and the agent (ATS, Eqs. 1-2).

`Field` maps points to signed distance, color and feature: a multi-resolution dense grid or an MLP with
positional encoding, and two small heads, with a learnable code per video for the scene. Where geometry was
fused beforehand (`FusedGeometry`), signed distance is fixed and the heads learn color and features alone.
`density` turns signed distance into the density of volume rendering. `ArticulatedBody` poses the agent's
field by Gaussian bones. `Reconstruction` holds all of it; `save` and `load` move it to and from a folder.
Points and distances are in meters.
"""

import json
import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, assert_never

import torch
from jaxtyping import Float, Int
from safetensors.torch import load_file, save_file
from torch import Tensor, nn
from torch.nn import functional

from pipeline.fields import fused_depth as fused
from pipeline.fields import skinning
from pipeline.fields.encodings import DenseGrid, PositionalMLP
from pipeline.fields.fused_depth import FusedGeometry

FEATURE_CHANNELS = 16
FUSED_CHANNELS = fused.CHANNELS
BETA_M = 0.006
"""the density's scale beta where distances are supervised, fixed: losses make it larger, and then thin limbs
blur and silhouettes get a halo"""
INITIAL_BETA_M, BETA_RANGE_M = 0.1, (0.004, 0.2)
"""initial beta and its range where rendering alone finds surfaces: samples are 0.1 m apart at first"""
MAX_START_SATURATION = 0.9
"""share of the truncation that an untrained distance stays below: at 1 its tanh has no gradient"""
MIN_FEATURE = 1e-4
"""shorter features are not normalized: their gradient would explode"""
CODE_STD = 0.1
"""standard deviation of untrained codes"""
LATTICE_M = 0.05
"""resolution at which a learned scene is extracted, below its finest cell"""
DELTA_VOXEL_M = 0.1
"""cell size of the grid of learned corrections of skinning weights"""
MIN_PROBABILITY = 0.02
"""fused colors are kept this far from 0 and 1 for their logit"""


@dataclass(frozen=True)
class FieldShape:
    """Everything that determines the shapes of a field's parameters."""

    low_m: tuple[float, float, float]
    """lower corner of the box"""
    high_m: tuple[float, float, float]
    """upper corner of the box"""
    voxel_m: tuple[float, ...]
    """edge of the grid's cells, coarse to fine"""
    grid_channels: int = 4
    width: int = 64
    """units of the hidden layer of each head"""
    videos: int = 0
    """number of codes; 0 = none"""
    code_channels: int = 8
    truncation_m: float | None = None
    """signed distances saturate here; None = never"""
    encoding: Literal["grid", "mlp"] = "grid"
    """dense grids, or the paper's MLP, positionally encoded, with wavelengths down to two finest cells"""
    starts_as_box: bool = False
    """signed distance is learned relative to that inside the box, for geometry learned by rendering alone"""


@dataclass(frozen=True)
class Values:
    """Values of a field at points."""

    signed_distance: Float[Tensor, "point"]
    color: Float[Tensor, "point 3"]
    feature: Float[Tensor, "point 16"]


def make_encoding(shape: FieldShape) -> DenseGrid | PositionalMLP:
    """Build the spatial encoding of a field."""
    match shape.encoding:
        case "grid":
            return DenseGrid(shape.low_m, shape.high_m, shape.voxel_m, shape.grid_channels)
        case "mlp":
            return PositionalMLP(shape.low_m, shape.high_m, min(shape.voxel_m), shape.width)
        case other:
            assert_never(other)


class Field(nn.Module):
    """Signed distance, color and feature at points (ATS, Eqs. 1 and 2)."""

    def __init__(self, shape: FieldShape, free_m: float, fused: FusedGeometry | None = None):
        """``free_m`` is the signed distance that an untrained field gives where nothing is fused."""
        super().__init__()
        self.shape, self.fused = shape, fused
        self.grid = make_encoding(shape)
        self.codes = nn.Embedding(max(shape.videos, 1), shape.code_channels) if shape.videos else None
        inputs = (
            self.grid.channels
            + (shape.code_channels if shape.videos else 0)
            + (FUSED_CHANNELS if fused else 0)
        )
        self.geometry = None
        if not fused:
            self.geometry, last = _head(inputs, shape.width, 1)
            limit = shape.truncation_m
            if shape.starts_as_box:
                nn.init.zeros_(last.weight)
                nn.init.zeros_(last.bias)
            elif limit:
                nn.init.constant_(last.bias, math.atanh(min(free_m / limit, MAX_START_SATURATION)))
            else:
                nn.init.constant_(last.bias, free_m)
        self.appearance, last = _head(inputs, shape.width, 3 + FEATURE_CHANNELS)
        if fused:
            nn.init.zeros_(last.weight.data[:3])
            nn.init.zeros_(last.bias.data[:3])
        self.log_beta = nn.Parameter(torch.tensor(math.log(INITIAL_BETA_M)))
        if self.codes:
            nn.init.normal_(self.codes.weight, std=CODE_STD)

    @property
    def lattice_m(self) -> float:
        """The resolution at which the surface is worth extracting, meters."""
        return self.fused.voxel_m if self.fused else LATTICE_M

    def encode(
        self,
        points: Float[Tensor, "point 3"],
        video: Int[Tensor, "point"] | None = None,
        code: Int[Tensor, "point"] | None = None,
    ) -> Float[Tensor, "point channel"]:
        """Return the encoding of points, the video's code and fused geometry, the input of both heads.

        Args:
            points: in the field's frame, meters.
            video: whose scene; -1 for the scene that the videos share. None without codes.
            code: whose code instead of the video's own (scene annealing).
        """
        parts = [self.grid(points)]
        if self.codes is not None:
            code = video if code is None else code
            assert code is not None, "a scene with codes needs the index of a video"
            parts.append(
                torch.where(code[:, None] < 0, self.codes.weight.mean(0), self.codes(code.clamp_min(0)))
            )
        if self.fused:
            parts.append(self.fused(points, video))
        if self.shape.starts_as_box:
            low, high = (points.new_tensor(corner) for corner in (self.shape.low_m, self.shape.high_m))
            parts.append(torch.minimum(points - low, high - points).amin(-1, keepdim=True))
        return torch.cat(parts, dim=-1)

    def distance(self, encoded: Float[Tensor, "point channel"]) -> Float[Tensor, "point"]:
        """Return signed distances, meters, positive in free space: fused ones, or else the head's."""
        limit = self.shape.truncation_m
        if self.geometry is None:
            assert limit is not None, "fused distances saturate"
            return limit * encoded[:, -FUSED_CHANNELS]
        if self.shape.starts_as_box:
            return encoded[:, -1] + self.geometry(encoded[:, :-1])[:, 0]
        raw = self.geometry(encoded)[:, 0]
        return limit * torch.tanh(raw) if limit else raw

    def color_and_feature(
        self, encoded: Float[Tensor, "point channel"]
    ) -> tuple[Float[Tensor, "point 3"], Float[Tensor, "point 16"]]:
        """Return color in 0..1 and unit-length features; the head corrects fused colors."""
        encoded = encoded[:, :-1] if self.shape.starts_as_box else encoded
        color, feature = self.appearance(encoded).split([3, FEATURE_CHANNELS], dim=-1)
        if self.fused:
            color = color + encoded[:, 1 - FUSED_CHANNELS : -1].logit(MIN_PROBABILITY)
        return color.sigmoid(), functional.normalize(feature, dim=-1, eps=MIN_FEATURE)

    def forward(
        self,
        points: Float[Tensor, "point 3"],
        video: Int[Tensor, "point"] | None = None,
        code: Int[Tensor, "point"] | None = None,
    ) -> Values:
        """Return all values at points; arguments as `encode`'s."""
        encoded = self.encode(points, video, code)
        return Values(self.distance(encoded), *self.color_and_feature(encoded))

    def distance_at(
        self,
        points: Float[Tensor, "point 3"],
        video: Int[Tensor, "point"],
        code: Int[Tensor, "point"] | None = None,
    ) -> Float[Tensor, "point"]:
        """Return signed distances alone, meters; arguments as `encode`'s."""
        if self.fused and self.shape.truncation_m:
            return self.shape.truncation_m * self.fused(points, video)[:, 0]
        return self.distance(self.encode(points, video, code))

    @property
    def beta_m(self) -> Float[Tensor, ""]:
        """The scale of the Laplace distribution in `density`, meters; learned by rendering alone."""
        learned = self.shape.starts_as_box
        return self.log_beta.exp().clamp(*BETA_RANGE_M) if learned else self.log_beta.new_tensor(BETA_M)

    def density(
        self, signed_distance: Float[Tensor, "*point"], min_beta_m: float = 0.0
    ) -> Float[Tensor, "*point"]:
        """Convert signed distances to density per meter; saturated distances are free space.

        ``min_beta_m``: the coarse pass of importance sampling sets it to half its sample spacing, so that no
        surface falls between two samples.
        """
        return density(signed_distance, self.beta_m.clamp_min(min_beta_m), self.shape.truncation_m)


def _head(inputs: int, width: int, outputs: int) -> tuple[nn.Sequential, nn.Linear]:
    """Return a two-layer MLP and its last layer."""
    first, last = nn.Linear(inputs, width), nn.Linear(width, outputs)
    return nn.Sequential(first, nn.ReLU(), last), last


def density(
    signed_distance: Float[Tensor, "*point"], beta_m: Float[Tensor, ""], truncation_m: float | None = None
) -> Float[Tensor, "*point"]:
    """Turn signed distance into volume density per meter: a Laplace CDF (Yariv et al., VolSDF, Eqs. 2-3).

    For distances that saturate at ``truncation_m`` the remaining tail of the CDF is subtracted; otherwise
    free space would accumulate opacity.
    """
    tail = 0.5 * torch.exp(-signed_distance.abs() / beta_m)
    cdf = torch.where(signed_distance > 0, tail, 1 - tail)
    if truncation_m is not None:
        cdf = (cdf - 0.5 * torch.exp(-truncation_m / beta_m)).clamp_min(0)
    return cdf / beta_m


class ArticulatedBody(nn.Module):
    """The agent's 25 Gaussian bones at rest and the skinning weights they give (ATS, Eq. 3)."""

    agent_from_bone_rest: Float[Tensor, "bone 4 4"]

    def __init__(
        self,
        agent_from_bone_rest: Float[Tensor, "bone 4 4"],
        bone_scale_m: Float[Tensor, "bone 3"],
        shape: FieldShape,
    ):
        """``shape``: box of the grid (`DELTA_VOXEL_M`) that holds the learned correction of the weights."""
        super().__init__()
        self.register_buffer("agent_from_bone_rest", agent_from_bone_rest)
        self.log_scale = nn.Parameter(bone_scale_m.log())
        self.delta = DenseGrid(shape.low_m, shape.high_m, (DELTA_VOXEL_M,), len(bone_scale_m), initial=0.0)

    @property
    def bone_scale_m(self) -> Float[Tensor, "bone 3"]:
        """Standard deviations of the Gaussian bones along their axes."""
        return self.log_scale.exp()

    def _delta(self, points_rest: Float[Tensor, "*#batch point 3"]) -> Float[Tensor, "*#batch point bone"]:
        return self.delta(points_rest.reshape(-1, 3)).view(*points_rest.shape[:-1], -1)

    def weights(self, points_rest: Float[Tensor, "*#batch point 3"]) -> Float[Tensor, "*#batch point bone"]:
        """Return the skinning weights of points of the rest shape."""
        return skinning.skinning_weights(
            points_rest, self.agent_from_bone_rest, self.bone_scale_m, delta=self._delta(points_rest)
        )

    def pose(
        self,
        points_rest: Float[Tensor, "*#batch point 3"],
        agent_from_bone: Float[Tensor, "*#batch bone 4 4"],
    ) -> Float[Tensor, "*#batch point 3"]:
        """Move points of the rest shape to where the posed bones take them (forward warp)."""
        return skinning.move(
            skinning.blend(self.weights(points_rest), agent_from_bone, self.agent_from_bone_rest), points_rest
        )

    def unpose(
        self,
        points_posed: Float[Tensor, "*#batch point 3"],
        agent_from_bone: Float[Tensor, "*#batch bone 4 4"],
    ) -> Float[Tensor, "*#batch point 3"]:
        """Move posed points back to the rest shape (backward warp).

        The weights come from the posed bones; the learned correction is read at the uncorrected rest points.
        """
        scale = self.bone_scale_m
        distance = -skinning.squared_mahalanobis(points_posed, agent_from_bone, scale)
        with torch.no_grad():
            guess = self._unwarp(points_posed, agent_from_bone, distance.softmax(-1))
        return self._unwarp(points_posed, agent_from_bone, (distance + self._delta(guess)).softmax(-1))

    def _unwarp(self, points_posed: Tensor, agent_from_bone: Tensor, weights: Tensor) -> Tensor:
        posed_from_rest = skinning.blend(weights, agent_from_bone, self.agent_from_bone_rest)
        return skinning.move(posed_from_rest, points_posed, inverse=True)


@dataclass(frozen=True)
class Reconstruction:
    """The canonical structure of one home and its animal, learned from all its videos."""

    scene: Field
    agent: Field
    body: ArticulatedBody
    videos: tuple[str, ...]
    """ids, in the order of the scene's codes"""

    def video_code(self, video: str | None) -> int:
        """Return the index of a video's code, or -1, the shared scene, for None."""
        return -1 if video is None else self.videos.index(video)


def save(folder: Path, reconstruction: Reconstruction) -> None:
    """Write ``scene_field.safetensors``, ``agent_field.safetensors`` (with the body) and ``fields.json``."""
    agent = {f"field.{key}": value for key, value in reconstruction.agent.state_dict().items()}
    agent |= {f"body.{key}": value for key, value in reconstruction.body.state_dict().items()}
    for name, state in (("scene_field", reconstruction.scene.state_dict()), ("agent_field", agent)):
        save_file(
            {key: value.detach().cpu().contiguous() for key, value in state.items()},
            folder / f"{name}.safetensors",
        )
    shapes = {"scene": asdict(reconstruction.scene.shape), "agent": asdict(reconstruction.agent.shape)}
    table = {
        "unit": "metre",
        "videos": reconstruction.videos,
        "bones": len(reconstruction.body.log_scale),
        **shapes,
    }
    (folder / "fields.json").write_text(json.dumps(table, indent=1) + "\n")


def load(folder: Path, device: str = "cpu") -> Reconstruction:
    """Read what `save` wrote, in evaluation mode without gradients."""
    table = json.loads((folder / "fields.json").read_text())
    shapes = {name: _shape_of(table[name]) for name in ("scene", "agent")}
    state = load_file(folder / "scene_field.safetensors")
    stored = {key.removeprefix("fused."): value for key, value in state.items() if key.startswith("fused.")}
    geometry = None
    if stored:
        voxel_m, truncation_m = stored["sizes"].tolist()
        geometry = FusedGeometry(stored["low"], voxel_m, truncation_m, stored["table"], stored["blocks"])
    scene = Field(shapes["scene"], free_m=0.1, fused=geometry)
    agent = Field(shapes["agent"], free_m=0.1)
    body = ArticulatedBody(
        torch.eye(4).repeat(table["bones"], 1, 1), torch.ones(table["bones"], 3), shapes["agent"]
    )
    scene.load_state_dict(state)
    state = load_file(folder / "agent_field.safetensors")
    for prefix, module in (("field.", agent), ("body.", body)):
        module.load_state_dict(
            {key.removeprefix(prefix): value for key, value in state.items() if key.startswith(prefix)}
        )
    for module in (scene, agent, body):
        module.to(device).requires_grad_(False).eval()
    return Reconstruction(scene, agent, body, tuple(table["videos"]))


def _shape_of(table: dict[str, Any]) -> FieldShape:
    values: dict[str, Any] = {
        key: tuple(value) if isinstance(value, list) else value for key, value in table.items()
    }
    return FieldShape(**values)
