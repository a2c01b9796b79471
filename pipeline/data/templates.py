"""Templates of scene and animal as files: cameras of walk-through and turnaround, vertex features, skin."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Float32

from pipeline.data.schema import FileSchema, Stored

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
class SceneCameras(Stored):
    """Cameras of the walk-through, OpenCV axes."""

    schema = SCENE_CAMERAS
    timestamp_s: Float[np.ndarray, "frame"]
    world_from_camera: Float[np.ndarray, "frame 4 4"]
    """of every frame; those not registered are placed by odometry"""
    intrinsics: Float[np.ndarray, "frame 3 3"]
    """color pixels"""
    registered: Bool[np.ndarray, "frame"]
    keyframe: Bool[np.ndarray, "frame"]
    """jointly optimized frames; the others were aligned to the resulting surface"""

    @property
    def world_from_registered(self) -> Float[np.ndarray, "frame 4 4"]:
        """`world_from_camera`, NaN where the frame was not registered."""
        return np.where(self.registered[:, None, None], self.world_from_camera, np.nan)

    @property
    def world_from_keyframe(self) -> Float[np.ndarray, "frame 4 4"]:
        """`world_from_camera`, NaN where the frame was not registered or is not a keyframe."""
        return np.where(self.keyframe[:, None, None], self.world_from_registered, np.nan)


@dataclass(frozen=True)
class AgentCameras(Stored):
    """Cameras of the turnaround, OpenCV axes; NaN where unusable."""

    schema = AGENT_CAMERAS
    timestamp_s: Float[np.ndarray, "frame"]
    agent_from_camera: Float[np.ndarray, "frame 4 4"]
    intrinsics: Float[np.ndarray, "frame 3 3"]
    """color pixels"""
    registered: Bool[np.ndarray, "frame"]

    @property
    def agent_from_registered(self) -> Float[np.ndarray, "frame 4 4"]:
        """`agent_from_camera`, NaN where the frame was not registered."""
        return np.where(self.registered[:, None, None], self.agent_from_camera, np.nan)


@dataclass(frozen=True)
class SkinTable(Stored):
    """Skinning of the adjacent `agent.ply`: blend weights, bones at rest and the sizes of their Gaussians."""

    schema = SKIN
    weights: Float[np.ndarray, "vertex bone"]
    agent_from_bone_rest: Float[np.ndarray, "bone 4 4"]
    bone_scale_m: Float[np.ndarray, "bone 3"]


def bones_at_rest(folder: Path) -> Float32[np.ndarray, "bone 4 4"]:
    """Read `agent_from_bone_rest` of any `skin.npz`, a table of motion's too. Raises InputError ART-010."""
    return SKIN.load(folder / "skin.npz", "agent_from_bone_rest")["agent_from_bone_rest"]


def read_floor(scene_template: Path) -> float:
    """Read the height of the floor from `world.json`, meters."""
    return float(json.loads((scene_template / "world.json").read_text())["floor"])


def read_vertex_features(template: Path) -> Float[np.ndarray, "vertex 16"]:
    """Read `vertex_features.npz` of a template: one unit descriptor per vertex. Raises InputError ART-010."""
    return VERTEX_FEATURES.load(template / "vertex_features.npz")["features"]


def write_vertex_features(template: Path, features: Float[np.ndarray, "vertex 16"]) -> None:
    """Write `vertex_features.npz` into a template in the making."""
    VERTEX_FEATURES.save(template / "vertex_features.npz", features=features)
