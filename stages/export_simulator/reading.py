"""Open what the simulator is made of: surfaces, skin, Gaussians, recorded motion, networks, volume."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Shaped

from pipeline.behavior.support import JUMP_KERNEL, SUPPORTED
from pipeline.behavior.trajectories import BehaviorData
from pipeline.core.errors import InputError
from pipeline.data import gaussian_ply, npz
from pipeline.longterm.bodies import SkinnedBody, load_body
from stages.export_simulator.actions import SessionClip, cut, longest_run

NETWORKS = ("perception", "goal", "path", "body")
_SHORTEST_CLIP_FRAMES = 16


@dataclass(frozen=True)
class SplatClouds:
    """Room (world frame) and animal (agent frame, at rest) as standard rows of 3D Gaussians."""

    scene: Float[np.ndarray, "scene_point 62"]
    agent: Float[np.ndarray, "agent_point 62"]
    agent_weights: Float[np.ndarray, "agent_point bone"]


@dataclass(frozen=True)
class BehaviorAssets:
    """The behavior models as files, and the scene's features they perceive."""

    contract: dict[str, Any]
    """of the sampler"""
    networks: dict[str, bytes]
    volume: dict[str, Any]
    """shape, origin and voxel size of `features`"""
    features: bytes
    """half precision, channel first"""
    voxels: dict[str, bytes]
    """one byte per voxel: `allowed`, where the animal may be, and `occupancy`, of which furniture is found"""
    supported: float | None
    """share of recorded frames whose root is above something that carries it; None where that is unknown"""


def body(reconstruction: Path) -> SkinnedBody:
    """Read the agent's surface and skin."""
    stored = load_body(reconstruction)
    return replace(stored, weights=stored.weights.astype(np.float64))


def motions(behavior_data: Path) -> list[SessionClip]:
    """Read the longest unbroken stretch of every session. Raises EXP-001 where none is long enough."""
    found = []
    for video, track in BehaviorData.load(behavior_data).trajectories.items():
        frames, bones = longest_run(track.valid), track.agent_from_bone.astype(np.float64)
        if frames.stop - frames.start >= _SHORTEST_CLIP_FRAMES:
            poses = track.world_from_agent, bones, track.world_from_camera
            found.append(cut(SessionClip(video, track.timestamp_s, *poses), frames))
    if not found:
        what = "no session shows the animal for 1.6 s without a break"
        remedy = "record longer sessions that keep the animal in view"
        raise InputError("EXP-001", what, str(behavior_data), remedy)
    return found


def support_contract(range_m: Float[np.ndarray, "2 2"]) -> dict[str, Any] | None:
    """Return what puts paths on what carries the animal, if known; see `pipeline.behavior.support`."""
    if not np.isfinite(range_m).all():
        return None
    return {"mark": SUPPORTED, "range_m": np.asarray(range_m, float).tolist(), "flight": JUMP_KERNEL.tolist()}


def supported_share(
    volume: Mapping[str, Shaped[np.ndarray, "..."]], roots: Float[np.ndarray, "frame 3"]
) -> float | None:
    """Return the share (0..1) of roots (world, meters) with a carrying voxel beneath them; None where
    nothing carries. ``volume`` holds the arrays of a `volume.npz`.
    """
    carries = volume["allowed"] >= SUPPORTED
    if not carries.any():
        return None
    column = np.floor((roots - volume["origin"]) / volume["voxel_m"]).astype(int)
    inside = ((column >= 0) & (column < carries.shape)).all(1)
    x, y, z = column[inside].T
    beneath = (carries[x, :, z] & (np.arange(carries.shape[1]) <= y[:, None])).any(1)
    return float(beneath.sum() / max(len(roots), 1))


def gaussians(scene: Path, splats: Path) -> SplatClouds:
    """Read room (a PLY) and animal (of the artifact `splats`) as Gaussians, and the animal's skin."""
    weights = gaussian_ply.SPLATS.load(splats / "splats.npz", "agent_weights")["agent_weights"]
    return SplatClouds(gaussian_ply.read(scene), gaussian_ply.read(splats / "agent.ply"), weights)


def behavior_assets(
    behavior: Path, volume: Path, roots_world: Float[np.ndarray, "frame 3"]
) -> BehaviorAssets:
    """Read the sampler's contract, the four networks, and the scene's features that they perceive.

    ``volume`` is a `volume.npz`, ``roots_world`` where the animal has been in it (meters). Raises InputError
    EXP-002 for a variant that the page's sampler does not know.
    """
    contract = json.loads((behavior / "behavior.json").read_bytes())
    family, ego = (contract["architecture"][key] for key in ("family", "ego"))
    if family != "diffusion" or ego == "world":
        what = f"the page cannot sample a model of the family {family} with the ego frame {ego}"
        remedy = "take another variant: family diffusion, ego yaw or full"
        raise InputError("EXP-002", what, str(behavior), remedy)
    table = npz.load(volume, names=("features", "occupancy", "allowed", "origin", "voxel_m", "stands_m"))
    return BehaviorAssets(
        contract=contract,
        networks={name: (behavior / f"{name}.onnx").read_bytes() for name in NETWORKS},
        volume={
            "shape": list(table["features"].shape),
            "origin": table["origin"].tolist(),
            "voxel_m": float(table["voxel_m"]),
            "support": support_contract(table["stands_m"]),
        },
        voxels={name: table[name].astype(np.uint8).tobytes() for name in ("allowed", "occupancy")},
        supported=supported_share(table, roots_world),
        features=table["features"].astype("<f2").tobytes(),
    )
