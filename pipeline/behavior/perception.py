"""Perception (omega of the paper): scene, others' past and own past as one code.

`world_from_ego` gives the frame of all inputs, `FeatureVolume.around` samples the scene in it, and
`Perception` encodes the three raw inputs (meters, ego frame) as 3 x 64 channels, normalized inside the
network. `PerceptionEnsemble` is an ensemble of such networks with weights of their own.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import assert_never, cast

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor, nn
from torch.utils.checkpoint import checkpoint

from pipeline.behavior.config import AblatedInput, Ego, ObservedPast, SceneEncoder
from pipeline.behavior.encoders import OtherPosesEncoder, OthersEncoder, PastEncoder
from pipeline.behavior.path_encoding import VELOCITY_POWER, with_powered_length
from pipeline.data import npz
from pipeline.geometry import rigid

CONDITIONS: tuple[AblatedInput, ...] = ("scene", "observer", "past")
GRID_SHAPE = (64, 8, 64)
GRID_CELL_M = 0.1
MAP_KEY_CHANNELS = 8
"""key channels of a map cell; it has as many value channels"""
POSITION = 3
"""leading channels of a past frame, the root's position; root rotation and bones follow"""
VELOCITY_CHANNELS = 3
"""channels of the condition for the velocity"""
MIN_HORIZONTAL = 0.2
"""minimum horizontal length of the unit head direction that defines a heading"""


def world_from_ego(
    world_from_agent: Float[np.ndarray, "*batch 4 4"], ego: Ego
) -> Float[np.ndarray, "*batch 4 4"]:
    """Return the ego frame at the agent's root, with its heading about world +y (``yaw``) or full rotation.

    If the head points straight up or down, belly or back direction defines the heading instead. The ablation
    ``world`` keeps the world's axes and horizontal origin, and takes only the height from the root.
    """
    if ego == "full":
        return np.asarray(world_from_agent, float)
    if ego == "world":
        frame = np.broadcast_to(np.eye(4), np.shape(world_from_agent)).copy()
        frame[..., 1, 3] = np.asarray(world_from_agent)[..., 1, 3]
        return frame
    rotation = np.asarray(world_from_agent, float)[..., :3, :3]
    head, back = rotation[..., :, 2], rotation[..., :, 1]
    lying = np.hypot(head[..., 0], head[..., 2]) < MIN_HORIZONTAL
    forward = np.where(lying[..., None], -np.sign(head[..., 1:2]) * back, head) * [1.0, 0.0, 1.0]
    forward /= np.linalg.norm(forward, axis=-1, keepdims=True)
    up = np.broadcast_to([0.0, 1.0, 0.0], forward.shape)
    axes = np.stack([np.cross(up, forward), up, forward], axis=-1)
    return rigid.make(axes, np.asarray(world_from_agent)[..., :3, 3])


@dataclass(frozen=True)
class FeatureVolume:
    """Voxel grid of scene features and occupancy in the world frame (Psi of the paper)."""

    features: Float[np.ndarray, "channel x y z"]
    occupancy: UInt8[np.ndarray, "x y z"]
    """0 free, 1 surface or inside, 2 unseen"""
    origin: Float[np.ndarray, "3"]
    """world position of the corner of voxel 0"""
    voxel_m: float

    @classmethod
    def load(cls, path: Path) -> "FeatureVolume":
        """Read `feature_volume.npz` or `volume.npz`. Raises InputError ART-010 when damaged."""
        stored = npz.load(path, ("features", "occupancy", "origin", "voxel_m"))
        return cls(stored["features"], stored["occupancy"], stored["origin"], float(stored["voxel_m"]))

    def voxel(
        self, points_world: Float[np.ndarray, "*batch 3"]
    ) -> tuple[Int[np.ndarray, "*batch 3"], Bool[np.ndarray, "*batch"]]:
        """Return the voxel that holds each point (clamped to the volume) and whether it lies inside."""
        index = np.floor((points_world - self.origin) / self.voxel_m).astype(np.int64)
        last = np.array(self.occupancy.shape) - 1
        clamped = np.clip(index, 0, last)
        return clamped, (index == clamped).all(-1)

    def around(self, ego: Float[np.ndarray, "batch 4 4"]) -> Float[np.ndarray, "batch channel 64 8 64"]:
        """Sample the nearest voxels on the ego grid (Eq. 11), centered at the root; zero outside."""
        index, inside = self.voxel(rigid.apply(ego, grid_points_ego().reshape(-1, 3)))
        features = self.features.reshape(len(self.features), -1)
        cell = np.asarray(np.ravel_multi_index(tuple(np.moveaxis(index, -1, 0)), self.occupancy.shape))
        grid = np.empty((len(ego), len(features), *GRID_SHAPE), np.float32)
        for number, each in enumerate(grid):
            known = features.take(cell[number], axis=1)
            np.multiply(known, inside[number], out=each.reshape(len(features), -1), dtype=np.float32)
        return grid


def grid_points_ego(stride: int = 1) -> Float[np.ndarray, "width height length 3"]:
    """Return the centers of the ego grid's cells, or of blocks of ``stride`` cells, in meters."""
    axes = [(np.arange(n // stride) + 0.5 - n / stride / 2) * GRID_CELL_M * stride for n in GRID_SHAPE]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)


SceneEncoding = tuple[Float[Tensor, "batch map"], Float[Tensor, "batch code"]]
"""Flattened map channels over cells (z, then x; empty without a map), and a code"""
PerceptionCode = tuple[
    Float[Tensor, "batch map"], Float[Tensor, "batch code_of_all"], Float[Tensor, "batch attended"]
]
"""Flattened map, the codes of scene, others and past concatenated, and attended positions of others"""


class PillarScene(nn.Module):
    """A 2.5-D encoder: average pooling, height folded into channels, 2-D convolutions down to 4 x 4.

    It also returns a map of the pooled blocks, for goals to attend to. Measured on minutes of data, blocks
    of 0.4 m predict as well as blocks of 0.2 m at a quarter of the time.
    """

    def __init__(self, channels: int, width: int, code: int, block: int):
        super().__init__()
        self.pool = nn.AvgPool3d(block)
        self.enter = nn.Sequential(nn.Conv2d(channels * GRID_SHAPE[1] // block, width, 1), nn.SiLU())
        layers: list[nn.Module] = []
        for _ in range(int(np.log2(GRID_SHAPE[0] // block // 4))):
            layers += [nn.Conv2d(width, width, 3, 2, 1), nn.SiLU()]
        self.convolutions = nn.Sequential(*layers)
        self.out = nn.Linear(width * 16, code)
        self.map = nn.Sequential(
            nn.Conv2d(width, width, 3, padding=1),
            nn.SiLU(),
            nn.Conv2d(width, 2 * MAP_KEY_CHANNELS, 3, padding=1),
        )

    def forward(self, grid: Float[Tensor, "batch channel 64 8 64"]) -> SceneEncoding:
        return self.encode(self.pool(grid))

    def encode(self, pooled: Float[Tensor, "batch channel x y z"]) -> SceneEncoding:
        """Encode a grid that is already pooled over blocks of cells."""
        blocks = self.enter(pooled.transpose(2, 3).flatten(1, 2).transpose(2, 3))
        return self.map(blocks).flatten(1), self.out(self.convolutions(blocks).flatten(1))


class VolumeScene(nn.Module):
    """The paper's encoder: six 3-D convolutions of kernel 3 with residual connections."""

    CHUNK = 64
    """scenes whose activations are held at once in training; those of the paper's 1,024 take 85 GB"""

    def __init__(self, channels: int, width: int, code: int):
        super().__init__()
        strides = [(1, 1, 1), (2, 1, 2), (2, 2, 2), (2, 2, 2), (2, 2, 2), (2, 1, 2)]
        inputs = [channels] + [width] * 5
        pairs = list(zip(inputs, strides, strict=True))
        self.convolutions = nn.ModuleList(nn.Conv3d(i, width, 3, s, 1) for i, s in pairs)
        self.shortcuts = nn.ModuleList(nn.Conv3d(i, width, 1, s) for i, s in pairs)
        self.out = nn.Linear(width, code)

    def forward(self, grid: Float[Tensor, "batch channel 64 8 64"]) -> SceneEncoding:
        if self.training:
            parts = grid.split(self.CHUNK)
            code = torch.cat([checkpoint(self.code, part, use_reentrant=False) for part in parts])
        else:
            code = self.code(grid)
        return grid.new_zeros(grid.shape[0], 0), code.float()

    def code(self, grid: Float[Tensor, "batch channel 64 8 64"]) -> Float[Tensor, "batch code"]:
        """Return the code alone."""
        for convolution, shortcut in zip(self.convolutions, self.shortcuts, strict=True):
            grid = nn.functional.silu(convolution(grid)) + shortcut(grid)
        return self.out(grid.mean((2, 3, 4)))

    encode = forward


class NoScene(nn.Module):
    """No scene: an empty map and a code of zeros."""

    def __init__(self, code: int):
        super().__init__()
        self.code = code

    def forward(self, grid: Float[Tensor, "batch channel 64 8 64"]) -> SceneEncoding:
        return grid.new_zeros(grid.shape[0], 0), grid.new_zeros(grid.shape[0], self.code)

    encode = forward


@dataclass(frozen=True)
class PerceptionConfig:
    """Sizes of the perception network."""

    scene: SceneEncoder
    observed_past: ObservedPast
    scene_width: int
    scene_block: int
    """cells that pillars average along each axis"""
    scene_channels: int
    hidden: int
    code: int
    past_frames: int
    past_channels: int
    observer_radius_m: float
    companions: bool
    rate_hz: float
    ablated_input: AblatedInput


class Perception(nn.Module):
    """Encoder of scene, others and past; ``keep`` 0 replaces one by its learned null (condition dropout)."""

    condition_mask: Tensor

    def __init__(self, size: PerceptionConfig):
        super().__init__()
        match size.scene:
            case "pillars":
                self.scene = PillarScene(size.scene_channels, size.scene_width, size.code, size.scene_block)
            case "volume":
                self.scene = VolumeScene(size.scene_channels, size.scene_width, size.code)
            case "none":
                self.scene = NoScene(size.code)
            case _:
                assert_never(size.scene)
        sizes = size.past_frames, size.hidden, size.code
        match size.observed_past:
            case "positions":
                self.others = OthersEncoder(
                    *sizes, size.observer_radius_m, size.rate_hz, positions=size.companions
                )
            case "poses":
                self.others = OtherPosesEncoder(*sizes)
            case _:
                assert_never(size.observed_past)
        self.rate_hz, self.code = size.rate_hz, size.code
        self.past = PastEncoder(size.past_frames, size.past_channels, size.hidden, size.code)
        condition_mask = torch.tensor([float(condition != size.ablated_input) for condition in CONDITIONS])
        self.register_buffer("condition_mask", condition_mask, persistent=False)
        self.scene_null = nn.Parameter(torch.zeros(size.code))
        self.past_null = nn.Parameter(torch.zeros(size.code))

    def forward(
        self,
        scene_grid: Float[Tensor, "batch channel 64 8 64"],
        others: Float[Tensor, "batch other past_frame 10"],
        past: Float[Tensor, "batch past"],
        keep: Float[Tensor, "batch 3"],
    ) -> PerceptionCode:
        """``keep`` holds 1 or 0 for scene, others and past."""
        return self.join(self.scene(scene_grid), others, self.past(past), keep)

    def join(
        self,
        scene_encoding: SceneEncoding,
        others: Float[Tensor, "batch other past_frame 10"],
        past: Float[Tensor, "batch code"],
        keep: Float[Tensor, "batch 3"],
    ) -> PerceptionCode:
        """Concatenate the codes, with nulls where ``keep`` is 0 or an input is ablated; a map's null is 0."""
        scene_map, scene = scene_encoding
        keep = keep * self.condition_mask
        set_code = self.others(others, keep[:, 1])
        set_code, attended = set_code[:, : self.code], set_code[:, self.code :]
        scene = torch.where(keep[:, :1] > 0.5, scene, self.scene_null)
        past = torch.where(keep[:, 2:] > 0.5, past, self.past_null)
        return scene_map * keep[:, :1], torch.cat([scene, set_code, past], dim=-1), attended


class PerceptionEnsemble(nn.Module):
    """An ensemble of perceptions; the condition is all maps, all codes, velocity and posture."""

    POSTURE_FRAMES = 3
    """last frames of the past, which give velocity and mean posture"""

    def __init__(self, size: PerceptionConfig, count: int):
        super().__init__()
        self.members = nn.ModuleList(Perception(size) for _ in range(count))

    def __iter__(self) -> Iterator[Perception]:
        return iter(cast(Iterable[Perception], self.members))  # torch's lists of modules are not generic

    @property
    def first(self) -> Perception:
        """The first member; sizes and scaling of past and others are the same in all."""
        return next(iter(self))

    def forward(
        self,
        scene_grid: Float[Tensor, "batch channel 64 8 64"],
        others: Float[Tensor, "batch other past_frame 10"],
        past: Float[Tensor, "batch past"],
        keep: Float[Tensor, "batch 3"],
    ) -> Float[Tensor, "batch condition"]:
        """``keep`` holds 1 or 0 for scene, others and past."""
        frames = past.unflatten(1, (self.first.past.frames, -1))[:, -self.POSTURE_FRAMES :]
        encodings = [member(scene_grid, others, past, keep) for member in self]
        return self.condition(encodings, self.now(frames, keep[:, 2]))

    def condition(
        self, encodings: list[PerceptionCode], now: Float[Tensor, "batch state"]
    ) -> Float[Tensor, "batch condition"]:
        """Concatenate the encodings of all members and the current state (omega, Eq. 11-13)."""
        maps = [scene_map for scene_map, _, _ in encodings]
        codes = [part for _, *parts in encodings for part in parts]
        return torch.cat([*maps, *codes, now], dim=-1)

    def now(
        self, frames: Float[Tensor, "batch frame channel"], keep: Float[Tensor, "batch"]
    ) -> Float[Tensor, "batch state"]:
        """Return velocity (as channels of paths) and scaled posture; zeros where the past is dropped."""
        member = self.first
        per_frame = member.rate_hz / (self.POSTURE_FRAMES - 1)
        velocity = (frames[:, -1, :POSITION] - frames[:, 0, :POSITION]) * per_frame
        posture = ((frames.mean(1) - member.past.mean) / member.past.std)[:, POSITION:]
        state = torch.cat([with_powered_length(velocity, VELOCITY_POWER), posture], dim=-1)
        return state * (keep * member.condition_mask[2])[:, None]
