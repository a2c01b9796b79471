"""Encoding of motions and bodies as channels of `pipeline.longterm.networks`, and decoding.

A clip's frame has its origin half way between its first and last root. `encode_clips` returns channels
(t, r, p) of two-second motions and the scene around them, `encode_places` the conditions of static bodies;
`decode_clip` turns channels into motion.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from pipeline.behavior.perception import world_from_ego
from pipeline.geometry import rigid, rigid_torch
from pipeline.longterm.bodies import PoseSpace
from pipeline.longterm.local_scene import LocalScene, distance_fields
from pipeline.longterm.networks import BODY_REACH_M, REACH_M, ROOT_CHANNELS
from pipeline.longterm.short_motions import BodyMotion
from pipeline.longterm.surroundings import MotionScene

COINCIDENT_M = 0.1
"""If start and end of a clip are closer than this, its frame takes the heading of the start."""


@dataclass(frozen=True)
class Clips:
    """Short motions in their own frames."""

    world_from_clip: Float[np.ndarray, "clip 4 4"]
    channels: Float[Tensor, "clip frame channel"]
    """t, r, p"""
    seen: LocalScene
    """the scene around each"""
    scene: Int[np.ndarray, "clip"]
    """index of the scene of each"""

    def __len__(self) -> int:
        return len(self.scene)


def root_channels(a_from_agent: Float[np.ndarray, "*batch 4 4"]) -> Float[Tensor, "*batch 9"]:
    """Return t and r of roots."""
    root = torch.from_numpy(np.asarray(a_from_agent)).float()
    return torch.cat([root[..., :3, 3], rigid_torch.rotation_to_6d(root[..., :3, :3])], dim=-1)


def clip_frames(
    start_world: Float[np.ndarray, "clip 4 4"], end_world: Float[np.ndarray, "clip 4 4"]
) -> Float[np.ndarray, "clip 4 4"]:
    """Return frames half way between start and end, +y up, +z from start to end, or along the heading."""
    frame = world_from_ego(start_world, "yaw")
    offset = (end_world - start_world)[:, :3, 3] * [1.0, 0.0, 1.0]
    length = np.linalg.norm(offset, axis=1, keepdims=True)
    forward = np.where(length > COINCIDENT_M, offset / np.maximum(length, 1e-9), frame[:, :3, 2])
    up = np.broadcast_to([0.0, 1.0, 0.0], forward.shape)
    rotation = np.stack([np.cross(up, forward), up, forward], axis=-1)
    return rigid.make(rotation, (start_world[:, :3, 3] + end_world[:, :3, 3]) / 2)


def encode_clips(
    root_world: Float[np.ndarray, "clip frame 4 4"],
    p: Float[Tensor, "clip frame pose"],
    scene: Int[np.ndarray, "clip"],
    scenes: Sequence[MotionScene],
    points: int,
    rng: np.random.Generator,
) -> Clips:
    """Encode clips, or only their first and last frames; ``scene`` is the index of each one's scene.

    With ``points`` 0 the scene is left out.
    """
    world_from_clip = clip_frames(root_world[:, 0], root_world[:, -1])
    root = root_channels(rigid.inverse(world_from_clip)[:, None] @ root_world)
    sampled = _points(world_from_clip, world_from_clip[:, :3, 3], scene, scenes, REACH_M, points, rng)
    seen = LocalScene(sampled, distance_fields(world_from_clip, scene, scenes if points else []))
    return Clips(world_from_clip, torch.cat([root, p], dim=-1), seen, scene)


def decode_clip(
    channels: Float[Tensor, "frame channel"],
    world_from_clip: Float[np.ndarray, "4 4"],
    poses: PoseSpace,
    ends: Float[np.ndarray, "2 bone 4 4"] | None = None,
) -> BodyMotion:
    """Decode the channels of one clip, or of static bodies, to motion in the world.

    The residual of the given poses ``ends`` outside the pose space is added, interpolated from first to last,
    so that the motion starts and ends in exactly these poses.
    """
    with torch.no_grad():
        posed = poses.decode(channels[..., ROOT_CHANNELS:])
        if ends is not None:
            given = poses.channels(ends)
            residual = given - poses.decode(poses.encode(given))
            share = torch.linspace(0, 1, len(channels))[:, None]
            posed = posed + torch.lerp(residual[0], residual[1], share)
        bones = poses.bones(posed)
        rotation = rigid_torch.rotation_from_6d(channels[..., 3:ROOT_CHANNELS])
        clip_from_agent = rigid_torch.make(rotation, channels[..., :3])
    return BodyMotion(world_from_clip @ clip_from_agent.double().numpy(), bones.double().numpy())


@dataclass(frozen=True)
class EncodedPlaces:
    """The conditions of static bodies, in the heading frames of their places."""

    world_from_place: Float[np.ndarray, "body 4 4"]
    place: Float[Tensor, "body 7"]
    """clearance above the scene, r"""
    points: Float[Tensor, "body point 3"]


def encode_places(
    world_from_agent: Float[np.ndarray, "body 4 4"],
    scene: Int[np.ndarray, "body"],
    scenes: Sequence[MotionScene],
    points: int,
    rng: np.random.Generator,
) -> EncodedPlaces:
    """Encode the places of static bodies: heading frame, clearance, orientation, scene points."""
    world_from_place = world_from_ego(world_from_agent, "yaw")
    center = np.asarray(world_from_agent)[:, :3, 3]
    clearance = torch.zeros(len(scene), 1)
    for index, each in enumerate(scenes):
        rows = np.flatnonzero(scene == index)
        clearance[rows, 0] = each.distance.at(torch.from_numpy(center[rows]).float())
    r = root_channels(rigid.inverse(world_from_place) @ world_from_agent)[:, 3:]
    seen = _points(world_from_place, center, scene, scenes, BODY_REACH_M, points, rng)
    return EncodedPlaces(world_from_place, torch.cat([clearance, r], dim=-1), seen)


def _points(
    frames: np.ndarray,
    center: np.ndarray,
    scene: np.ndarray,
    scenes: Sequence[MotionScene],
    reach_m: float,
    count: int,
    rng: np.random.Generator,
) -> Float[Tensor, "clip point 3"]:
    sampled = np.zeros((len(scene), count, 3), np.float32)
    for index, each in enumerate(scenes):
        rows = np.flatnonzero(scene == index)
        sampled[rows] = each.around(frames[rows], center[rows], reach_m, count, rng)
    return torch.from_numpy(sampled)
