"""Registered poses of one recording as files: `poses.npz` of `video_poses/<id>` and `registration/<id>`."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from pipeline.data.schema import FileSchema, Stored

POSES = FileSchema.of(
    "registration/poses.npz",
    "timestamp_s [frame] f8",
    "world_from_camera [frame 4 4] f8",
    "world_from_agent [frame 4 4] f8",
    "confidence [frame] f4",
    "agent_confidence [frame] f4",
    "agent_visible [frame] bool",
)


@dataclass(frozen=True)
class RegisteredPoses(Stored):
    """Poses of camera (OpenCV axes) and agent in the world, per frame."""

    schema = POSES
    timestamp_s: Float[np.ndarray, "frame"]
    world_from_camera: Float[np.ndarray, "frame 4 4"]
    world_from_agent: Float[np.ndarray, "frame 4 4"]
    """NaN where the agent is not visible"""
    confidence: Float[np.ndarray, "frame"]
    """probability that the camera pose is within 2 deg and 5 cm"""
    agent_confidence: Float[np.ndarray, "frame"]
    agent_visible: Bool[np.ndarray, "frame"]

    @classmethod
    def open(cls, folder: Path) -> "RegisteredPoses | None":
        """Read a recording's `poses.npz`; None if its registration was refused. Raises InputError ART-010."""
        return super().open(folder) if (folder / "poses.npz").exists() else None

    @classmethod
    def unknown(cls, timestamp_s: Float[np.ndarray, "frame"]) -> "RegisteredPoses":
        """Return the poses of a refused recording: NaN with confidence 0."""
        nowhere, nothing = np.full((len(timestamp_s), 4, 4), np.nan), np.zeros(len(timestamp_s))
        return cls(timestamp_s, nowhere, nowhere, nothing, nothing, nothing > 0)
