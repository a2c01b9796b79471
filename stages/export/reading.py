"""Open what is exported: the skinned animal with its motions, sessions, pictures with their cameras."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float, UInt8

from pipeline.core.errors import other_versions_refused
from pipeline.data import gaussian_ply, images, motion, npz
from pipeline.data import glb as gltf
from pipeline.data.glb import Action, Skin
from pipeline.data.motion import Motion
from pipeline.geometry.meshes import Mesh
from pipeline.geometry.subsampling import evenly


@dataclass(frozen=True)
class Agent:
    """The skinned animal, agent frame, meters; its motions, named."""

    mesh: Mesh
    skin: Skin
    actions: list[Action]
    rate_hz: float
    """keys per second of all motions"""
    skinning_loss_mm: dict[str, float]
    """linear weights against the reconstruction's dual quaternions"""
    retargeting_loss_mm: dict[str, float] = field(default_factory=dict)
    """where the motions are another animal's, see `pipeline.fields.retargeting`"""

    @property
    def loss_mm(self) -> dict[str, float]:
        """Return what any format loses of the reconstruction."""
        skinning = {f"skinning_{name}": value for name, value in self.skinning_loss_mm.items()}
        return skinning | self.retargeting_loss_mm


@dataclass(frozen=True)
class CameraFrame:
    """One picture and its camera (OpenCV axes); files are read when they are written."""

    video: str
    index: int
    world_from_camera: Float[np.ndarray, "4 4"]
    intrinsics: Float[np.ndarray, "3 3"]
    frames: Path
    masks: Path | None

    @property
    def name(self) -> str:
        """File name without ending, unique among all recordings."""
        return f"{self.video}_{self.index:06d}"

    @property
    def jpeg(self) -> bytes:
        """The picture as it is stored."""
        return (self.frames / f"color/{self.index:06d}.jpg").read_bytes()

    @property
    def depth(self) -> Float[np.ndarray, "height width"]:
        """Meters along z, 0 where unknown."""
        return images.read_depth(self.frames / f"depth/{self.index:06d}.exr")

    @property
    def agent_mask(self) -> UInt8[np.ndarray, "height width"] | None:
        """255 where the animal is or may be; None where there is no animal to mask."""
        if self.masks is None:
            return None
        return np.where(images.read_gray(self.masks / f"{self.index:06d}.png") > 0, 255, 0).astype(np.uint8)


def agent(simulator: Path, take: Path | None, rate_hz: float) -> Agent:
    """Read the animal from `agent.glb`, keys resampled to `rate_hz`; a generated take is one motion more."""
    with other_versions_refused("simulator", str(simulator)):
        mesh, skin, actions = gltf.read_skinned((simulator / "agent.glb").read_bytes())
        loss_mm = json.loads((simulator / "simulator.json").read_bytes())["agent"]["skinning_residual_mm"]
    if take:
        names = ("timestamp_s", "world_from_agent", "agent_from_bone")
        made = npz.load(take, names)
        actions = [*actions, Action("generated", *(made[name].astype(np.float64) for name in names))]
    return Agent(mesh, skin, [action.resampled(rate_hz) for action in actions], rate_hz, loss_mm)


def room(simulator: Path) -> Mesh:
    """Read the room's surface, world frame."""
    with other_versions_refused("simulator", str(simulator)):
        return gltf.read_static((simulator / "scene.glb").read_bytes())


def sessions(reconstruction: Path) -> dict[str, Motion]:
    """Read every session's motion, in id order; NaN where the animal was never recoverable."""
    return {file.parent.name: motion.load(file) for file in sorted(reconstruction.glob("*/motion.npz"))}


def camera_frames(
    reconstruction: Path, frames: Mapping[str, Path], masks: Mapping[str, Path], per_video: int
) -> list[CameraFrame]:
    """Choose frames with a known camera from the walk-through and all sessions, evenly spread over each."""
    found = []
    for video, folder in frames.items():
        file = reconstruction / video / "motion.npz"
        if not file.exists() and video not in masks:  # the turnaround has a world of its own
            file = reconstruction / "templates" / f"{video}.npz"
        if not file.exists():
            continue
        cameras = npz.load(file, ("world_from_camera",))["world_from_camera"]
        intrinsics = npz.load(folder / "frames.npz", ("intrinsics",))["intrinsics"]
        known = np.flatnonzero(np.isfinite(cameras).all((1, 2)))
        chosen, mask = known[evenly(len(known), per_video, rounded=True)], masks.get(video)
        found += [CameraFrame(video, int(i), cameras[i], intrinsics[i], folder, mask) for i in chosen]
    return found


def gaussians(splats: Path) -> dict[str, Float[np.ndarray, "point 62"]]:
    """Read both clouds as standard rows."""
    return {name: gaussian_ply.read(splats / f"{name}.ply") for name in ("scene", "agent")}
