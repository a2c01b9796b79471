"""Register one session from its frames, masks and features, and write its poses and status."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from pipeline.core.devices import Device
from pipeline.data import ply, qa
from pipeline.data.clips import Clip, Masks
from pipeline.data.features import open_features
from pipeline.data.templates import SceneCameras, read_floor, read_vertex_features
from pipeline.localization import localizer as localizers
from stages.register_videos import pictures, registration
from stages.register_videos.config import Config
from stages.register_videos.point_alignment import Walkthrough
from stages.register_videos.registration import Maps, Registered, Rejected


@dataclass(frozen=True)
class Inputs:
    """Folders of finished artifacts of one session, and of the agent."""

    frames: Path
    masks: Path
    scene_template: Path
    agent_template: Path
    scene_localizer: Path
    agent_localizer: Path
    walk: Mapping[str, Path]
    """Frames of walk-throughs; the first one is used."""
    features: Path | None = None
    """Without features there is no feature-metric alignment."""


def run(inputs: Inputs, config: Config, out: Path, *, device: Device = "cpu") -> Registered | Rejected:
    """Register one session and write its poses, or the reason for its rejection."""
    clip, masks = Clip.open(inputs.frames), Masks.open(inputs.masks)
    walk = SceneCameras.open(inputs.scene_template)
    features, scene_features = None, None
    if inputs.features is not None:
        features = open_features(inputs.features)
        scene_features = read_vertex_features(inputs.scene_template).astype(np.float32)
    maps = Maps(
        scene=ply.read_ply(inputs.scene_template / "mesh.ply"),
        floor_m=read_floor(inputs.scene_template),
        agent=ply.read_ply(inputs.agent_template / "agent.ply"),
        scene_localizer=localizers.load(inputs.scene_localizer, device),
        agent_localizer=localizers.load(inputs.agent_localizer, device),
        scene_features=scene_features,
        walk=Walkthrough(Clip.open(next(iter(inputs.walk.values()))), walk.world_from_keyframe),
    )
    rng = np.random.default_rng(config.seed)
    result = registration.register(clip, masks, maps, config, rng, features)
    if isinstance(result, Registered):
        result.poses(clip.timestamp_s).write(out)
    else:
        folders = inputs.frames, *inputs.walk.values()
        faults = [fault for folder in folders for fault in qa.failures(folder)]
        if faults:
            result = replace(result, reason=f"{result.reason}; a check of frames failed: {faults[0]}")
    status = pictures.status(result, walk.timestamp_s, walk.world_from_camera)
    (out / "status.json").write_text(json.dumps(status, indent=1) + "\n")
    qa.write(
        out,
        good="template edges lie on the frames' edges, the animal's outline fits, paths stay in free space",
        bad="edges are shifted, paths cross walls, the animal faces backwards",
        checks=pictures.checks(result, mapped=clip.mapped), pictures=pictures.pictures(result, clip, maps),
    )  # fmt: skip
    return result
