"""The time-varying structure D: poses of camera, agent and bones in every frame.

`Motion` is one video's result as files hold it (`save`, `load`), `MotionTable` all videos' while it is being
optimized: initial poses and small learned se(3) corrections on their right side.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from pipeline.data.schema import FileSchema
from pipeline.geometry import rigid, rigid_torch

MOTION = FileSchema.of(
    "reconstruction/motion.npz",
    "timestamp_s [frame] f8",
    "world_from_camera [frame 4 4] f8",
    "world_from_agent [frame 4 4] f8",
    "agent_from_bone [frame bone 4 4] f4",
    "confidence [frame] f4",
    "agent_visible [frame] bool",
)
TRACKS = FileSchema.of("reconstruction/tracks.npz", "vertex_index [point] i8", "rest_agent [point 3] f4")
FEATURE_VOLUME = FileSchema.of(
    "reconstruction/feature_volume.npz",
    "features [channel x y z] f2",
    "occupancy [x y z] u1",
    "origin [3] f8",
    "voxel_m [] f8",
)
DOUBTFUL = 0.1
"""frames with lower confidence are not used"""
INTERPOLATED = 0.05
"""maximum confidence of frames whose agent pose is interpolated over a long gap"""


@dataclass(frozen=True)
class Motion:
    """Poses of one video; the agent's are NaN where unknown, and of low confidence where interpolated."""

    timestamp_s: Float[np.ndarray, "frame"]
    world_from_camera: Float[np.ndarray, "frame 4 4"]
    world_from_agent: Float[np.ndarray, "frame 4 4"]
    agent_from_bone: Float[np.ndarray, "frame bone 4 4"]
    confidence: Float[np.ndarray, "frame"]
    agent_visible: Bool[np.ndarray, "frame"]

    @property
    def agent_known(self) -> Bool[np.ndarray, "frame"]:
        """Frames whose agent pose was observed nearby in time."""
        return np.isfinite(self.world_from_agent).all((1, 2)) & (self.confidence >= DOUBTFUL)

    def at(
        self, query_s: float
    ) -> tuple[Float[np.ndarray, "4 4"] | None, Float[np.ndarray, "bone 4 4"] | None]:
        """Return the agent's root and bones interpolated at one time; None if unknown."""
        after = int(np.clip(np.searchsorted(self.timestamp_s, query_s), 1, len(self.timestamp_s) - 1))
        pair = slice(after - 1, after + 1)
        if not np.isfinite(self.world_from_agent[pair]).all():
            return None, None
        when, query = self.timestamp_s[pair], np.clip([query_s], *self.timestamp_s[pair])
        body = self.world_from_agent[pair], self.agent_from_bone[pair]
        root, bones = rigid.interpolate_body(when, *body, query)
        return root[0], bones[0]


def save(path: Path, motion: Motion) -> None:
    """Write a ``motion.npz``."""
    MOTION.save(path, **vars(motion))


def load(path: Path) -> Motion:
    """Read a ``motion.npz``. Raises InputError ART-010 for anything else."""
    return Motion(**MOTION.load(path))


def gaps_s(
    timestamp_s: Float[np.ndarray, "frame"], good: Bool[np.ndarray, "frame"]
) -> Float[np.ndarray, "frame"]:
    """Return the gap between the good frames around each frame: 0 for good ones, infinite at the ends."""
    when = np.concatenate([[-np.inf], timestamp_s[good], [np.inf]])
    after = np.searchsorted(when, timestamp_s)
    return np.where(good, 0.0, when[after] - when[after - 1])


class MotionTable(nn.Module):
    """Concatenated poses of all frames of all videos, with learned corrections.

    A pose is ``initial @ exp(correction)``. Cameras are corrected at knots, linearly between them:
    registration leaves slow drift, not jitter. Videos whose camera is held (templates) keep the initial
    poses.
    """

    knot: Int[Tensor, "frame"]
    knot_share: Float[Tensor, "frame"]
    camera_free: Float[Tensor, "frame"]
    initial_camera: Float[Tensor, "frame 4 4"]
    initial_agent: Float[Tensor, "frame 4 4"]
    agent_from_bone_rest: Float[Tensor, "bone 4 4"]

    def __init__(
        self,
        world_from_camera: Float[Tensor, "frame 4 4"],
        world_from_agent: Float[Tensor, "frame 4 4"],
        agent_from_bone_rest: Float[Tensor, "bone 4 4"],
        frames_per_video: Sequence[int],
        camera_free: Sequence[bool],
        knot_frames: int = 10,
    ):
        super().__init__()
        knots, before, share, free = 0, [], [], []
        for frames, is_free in zip(frames_per_video, camera_free, strict=True):
            place = torch.arange(frames) / knot_frames
            before.append(place.floor().long() + knots)
            share.append(place - place.floor())
            free.append(torch.full((frames,), float(is_free)))
            knots += (frames - 1) // knot_frames + 2
        fixed = {
            "knot": torch.cat(before),
            "knot_share": torch.cat(share),
            "camera_free": torch.cat(free),
            "initial_camera": world_from_camera.float(),
            "initial_agent": world_from_agent.float(),
            "agent_from_bone_rest": agent_from_bone_rest.float(),
        }
        for name, value in fixed.items():
            self.register_buffer(name, value, persistent=False)
        self.camera = nn.Parameter(torch.zeros(knots, 6))
        self.root = nn.Parameter(torch.zeros(len(world_from_camera), 6))
        self.bone = nn.Parameter(torch.zeros(len(world_from_camera), len(agent_from_bone_rest), 6))

    def world_from_camera(self, frame: Int[Tensor, "*batch"]) -> Float[Tensor, "*batch 4 4"]:
        """Return camera poses, corrected by twists that are interpolated between knots."""
        share = self.knot_share[frame][..., None]
        mixed = (1 - share) * self.camera[self.knot[frame]] + share * self.camera[self.knot[frame] + 1]
        return self.initial_camera[frame] @ rigid_torch.se3_exp(mixed * self.camera_free[frame][..., None])

    def world_from_agent(self, frame: Int[Tensor, "*batch"]) -> Float[Tensor, "*batch 4 4"]:
        """Return the agent's root poses."""
        return self.initial_agent[frame] @ rigid_torch.se3_exp(self.root[frame])

    def agent_from_bone(self, frame: Int[Tensor, "*batch"]) -> Float[Tensor, "*batch bone 4 4"]:
        """Return posed bones, meters, agent frame."""
        return self.agent_from_bone_rest @ rigid_torch.se3_exp(self.bone[frame])
