"""Open what the simulator is made of: surfaces, skin, Gaussians, recorded motion, networks, feature volume."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from pipeline.errors import InputError
from pipeline.files import arrays, gaussian_rows, meshes
from pipeline.models.support import CARRIES, FLIGHT
from pipeline.models.trajectories import BehaviorData
from pipeline.space.meshes import Mesh
from stages.export_simulator.actions import Motion, cut, longest_run

NETWORKS = ("perception", "goal", "path", "body")
_SHORTEST_CLIP_FRAMES = 16


@dataclass(frozen=True)
class Body:
    """The canonical agent: surface and skin, agent frame, metres."""

    mesh: Mesh
    weights: Float[np.ndarray, "vertex bone"]
    agent_from_bone_rest: Float[np.ndarray, "bone 4 4"]


@dataclass(frozen=True)
class Gaussians:
    """Room (world frame) and animal (agent frame, at rest) as standard rows of 3D Gaussians."""

    scene: Float[np.ndarray, "point 62"]
    agent: Float[np.ndarray, "point 62"]
    agent_weights: Float[np.ndarray, "point bone"]


@dataclass(frozen=True)
class Minds:
    """The behaviour models as files, and the scene's features they perceive."""

    behavior: dict[str, Any]
    """the sampler's contract"""
    networks: dict[str, bytes]
    volume: dict[str, Any]
    """shape, origin and voxel size of `features`"""
    features: bytes
    """half precision, channel first"""
    allowed: bytes
    """one byte per voxel: where the animal may be"""


def body(reconstruction: Path) -> Body:
    """Read the agent's surface and skin."""
    skin = arrays.load(reconstruction / "skin.npz", names=("weights", "agent_from_bone_rest"))
    return Body(
        meshes.read_ply(reconstruction / "agent.ply"),
        skin["weights"].astype(np.float64),
        skin["agent_from_bone_rest"].astype(np.float64),
    )


def scene(reconstruction: Path) -> Mesh:
    """Read the room's surface, world frame."""
    return meshes.read_ply(reconstruction / "scene.ply")


def motions(behavior_data: Path) -> list[Motion]:
    """Read the longest unbroken stretch of every session. Raises InputError EXP-001 where none is long enough."""
    found = []
    for video, track in BehaviorData.load(behavior_data).trajectories.items():
        whole = Motion(
            video,
            track.timestamp_s,
            track.world_from_agent,
            track.agent_from_bone.astype(np.float64),
            track.world_from_camera,
        )
        frames = longest_run(track.valid)
        if frames.stop - frames.start >= _SHORTEST_CLIP_FRAMES:
            found.append(cut(whole, frames))
    if not found:
        raise InputError(
            "EXP-001",
            "no session shows the animal for 1.6 s without a break",
            str(behavior_data),
            "record longer sessions that keep the animal in view",
        )
    return found


def support(range_m: Float[np.ndarray, "2 2"]) -> dict[str, Any] | None:
    """Return what puts paths on what carries the animal, where that is known; see `pipeline.models.support`."""
    if not np.isfinite(range_m).all():
        return None
    return {"mark": CARRIES, "range_m": np.asarray(range_m, float).tolist(), "flight": FLIGHT.tolist()}


def gaussians(splats: Path) -> Gaussians:
    """Read room and animal as Gaussians, and the animal's skin."""
    weights = arrays.load(splats / "splats.npz", names=("agent_weights",))["agent_weights"]
    return Gaussians(gaussian_rows.read(splats / "scene.ply"), gaussian_rows.read(splats / "agent.ply"), weights)


def minds(behavior: Path, behavior_data: Path) -> Minds:
    """Read the sampler's contract, the four networks, and the scene's features that they perceive.

    Raises InputError EXP-002 for a variant that the page's sampler does not know.
    """
    contract = json.loads((behavior / "behavior.json").read_bytes())
    family, ego = (contract["architecture"][key] for key in ("family", "ego"))
    if family != "diffusion" or ego == "world":
        what = f"the page cannot sample a model of the family {family} with the ego frame {ego}"
        raise InputError("EXP-002", what, str(behavior), "take another variant: family diffusion, ego yaw or full")
    table = arrays.load(behavior_data / "volume.npz", names=("features", "allowed", "origin", "voxel_m", "stands_m"))
    return Minds(
        behavior=contract,
        networks={name: (behavior / f"{name}.onnx").read_bytes() for name in NETWORKS},
        volume={
            "shape": list(table["features"].shape),
            "origin": table["origin"].tolist(),
            "voxel_m": float(table["voxel_m"]),
            "support": support(table["stands_m"]),
        },
        allowed=table["allowed"].astype(np.uint8).tobytes(),
        features=table["features"].astype("<f2").tobytes(),
    )
