"""Templates of scene and animal as files: cameras of walk-through and turnaround, vertex features, skin."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Float32

from pipeline.data.schema import FileSchema

SCENE_CAMERAS = FileSchema.of(
    "scene_template/cameras.npz",
    "timestamp_s [frame] f8",
    "world_from_camera [frame 4 4] f8",
    "intrinsics [frame 3 3] f8",
    "registered [frame] bool",
    "keyframe [frame] bool",
)
AGENT_CAMERAS = FileSchema.of(
    "agent_template/cameras.npz",
    "timestamp_s [frame] f8",
    "agent_from_camera [frame 4 4] f8",
    "intrinsics [frame 3 3] f8",
    "registered [frame] bool",
)
VERTEX_FEATURES = FileSchema.of("scene_template/vertex_features.npz", "features [vertex 16] f2")
SKIN = FileSchema.of(
    "agent_template/skin.npz",
    "weights [vertex bone] f4",
    "agent_from_bone_rest [bone 4 4] f4",
    "bone_scale_m [bone 3] f4",
)


@dataclass(frozen=True)
class SceneCameras:
    """Cameras of the walk-through, OpenCV axes."""

    timestamp_s: Float[np.ndarray, "frame"]
    world_from_camera: Float[np.ndarray, "frame 4 4"]
    """of every frame; those not registered are placed by odometry"""
    intrinsics: Float[np.ndarray, "frame 3 3"]
    """color pixels"""
    registered: Bool[np.ndarray, "frame"]
    keyframe: Bool[np.ndarray, "frame"]
    """jointly optimized frames; the others were aligned to the resulting surface"""

    @classmethod
    def open(cls, scene_template: Path) -> "SceneCameras":
        """Read `cameras.npz` of a finished `scene_template`. Raises InputError ART-010."""
        return cls(**SCENE_CAMERAS.load(scene_template / "cameras.npz"))

    def write(self, scene_template: Path) -> None:
        """Write `cameras.npz` into a template in the making."""
        SCENE_CAMERAS.save(scene_template / "cameras.npz", **vars(self))

    @property
    def world_from_registered(self) -> Float[np.ndarray, "frame 4 4"]:
        """`world_from_camera`, NaN where the frame was not registered."""
        return np.where(self.registered[:, None, None], self.world_from_camera, np.nan)

    @property
    def world_from_keyframe(self) -> Float[np.ndarray, "frame 4 4"]:
        """`world_from_camera`, NaN where the frame was not registered or is not a keyframe."""
        return np.where(self.keyframe[:, None, None], self.world_from_registered, np.nan)


@dataclass(frozen=True)
class AgentCameras:
    """Cameras of the turnaround, OpenCV axes; NaN where unusable."""

    timestamp_s: Float[np.ndarray, "frame"]
    agent_from_camera: Float[np.ndarray, "frame 4 4"]
    intrinsics: Float[np.ndarray, "frame 3 3"]
    """color pixels"""
    registered: Bool[np.ndarray, "frame"]

    @classmethod
    def open(cls, agent_template: Path) -> "AgentCameras":
        """Read `cameras.npz` of a finished `agent_template`. Raises InputError ART-010."""
        return cls(**AGENT_CAMERAS.load(agent_template / "cameras.npz"))

    def write(self, agent_template: Path) -> None:
        """Write `cameras.npz` into a template in the making."""
        AGENT_CAMERAS.save(agent_template / "cameras.npz", **vars(self))

    @property
    def agent_from_registered(self) -> Float[np.ndarray, "frame 4 4"]:
        """`agent_from_camera`, NaN where the frame was not registered."""
        return np.where(self.registered[:, None, None], self.agent_from_camera, np.nan)


@dataclass(frozen=True)
class SkinTable:
    """Skinning of `agent.ply`: blend weights, bones at rest and the sizes of their Gaussians."""

    weights: Float[np.ndarray, "vertex bone"]
    agent_from_bone_rest: Float[np.ndarray, "bone 4 4"]
    bone_scale_m: Float[np.ndarray, "bone 3"]

    @classmethod
    def open(cls, folder: Path) -> "SkinTable":
        """Read `skin.npz` of a finished `agent_template` or `reconstruction`. Raises InputError ART-010."""
        return cls(**SKIN.load(folder / "skin.npz"))

    def write(self, folder: Path) -> None:
        """Write `skin.npz` into an artifact in the making."""
        SKIN.save(folder / "skin.npz", **vars(self))


def bones_at_rest(folder: Path) -> Float32[np.ndarray, "bone 4 4"]:
    """Read `agent_from_bone_rest` of any `skin.npz`, a table of motion's too. Raises InputError ART-010."""
    return SKIN.load(folder / "skin.npz", "agent_from_bone_rest")["agent_from_bone_rest"]


def read_vertex_features(template: Path) -> Float[np.ndarray, "vertex 16"]:
    """Read `vertex_features.npz` of a template: one unit descriptor per vertex. Raises InputError ART-010."""
    return VERTEX_FEATURES.load(template / "vertex_features.npz")["features"]


def write_vertex_features(template: Path, features: Float[np.ndarray, "vertex 16"]) -> None:
    """Write `vertex_features.npz` into a template in the making."""
    VERTEX_FEATURES.save(template / "vertex_features.npz", features=features)
