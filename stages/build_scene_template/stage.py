"""Build the scene template from the walk-through's frames and features, and write its files."""

import json
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.core.progress import log
from pipeline.data import ply, qa
from pipeline.data.clips import Clip
from pipeline.data.features import open_features
from pipeline.data.templates import SceneCameras, write_vertex_features
from stages.build_scene_template import own_mesh, pictures, template
from stages.build_scene_template.config import Config


@dataclass(frozen=True)
class Inputs:
    """Folders of finished artifacts, by recording."""

    frames: Mapping[str, Path]
    """Walk-throughs; the first one is used."""
    features: Mapping[str, Path]
    """Their features."""


def run(inputs: Inputs, config: Config, out: Path) -> template.SceneTemplate:
    """Build the template and write it. Raises InputError MAP-001, MAP-002, MAP-003 and MAP-005."""
    (video, frames), *others = inputs.frames.items()
    if others:
        log(f"several walk-throughs: using {video}")
    clip = Clip.open(frames)
    features = open_features(inputs.features[video])
    built, sparse, mesh = None, None, frames / "mesh.ply"
    if mesh.exists() and config.own_mesh:
        built = own_mesh.build(clip, features, ply.read_ply(mesh), config)
    if built is None:
        with tempfile.TemporaryDirectory() as workspace:
            built, sparse = template.build(clip, features, config, Path(workspace))
    normals = built.mesh.vertex_normals()
    ply.write_ply(out / "mesh.ply", built.mesh, nx=normals[:, 0], ny=normals[:, 1], nz=normals[:, 2])
    write_vertex_features(out, built.features.astype(np.float16))
    cameras = built.world_from_camera, clip.intrinsics, built.registered, built.keyframe
    SceneCameras(clip.timestamp_s, *cameras).write(out)
    (out / "world.json").write_text(json.dumps(pictures.world(built), indent=1) + "\n")
    template.write_model(sparse, built.world_from_camera, out / "colmap")
    qa.write(
        out, good="walls are straight, furniture is whole, frames and renderings agree",
        bad="walls are doubled or bent, the path jumps, large parts are missing",
        checks=pictures.checks(built), pictures=pictures.pictures(built, clip),
    )  # fmt: skip
    return built
