"""Build the scene template from the walk-through.

COLMAP (CPU, one thread) finds the keyframes' poses; depth gives the scale, checks the poses and, with the odometry,
replaces them where it refutes them; gravity turns +y up. Depth and colour are fused to a mesh, every frame is aligned to
it, pymeshlab cleans it. Writes mesh.ply, vertex_features.npz, cameras.npz, world.json and colmap/.
"""

import json
import tempfile
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from pipeline import cli, qa
from pipeline.files import arrays, meshes
from pipeline.files.clips import Clip
from pipeline.progress import log
from stages.build_scene_template import given, pictures, template
from stages.build_scene_template.anchor import AnchorOptions
from stages.build_scene_template.fuse import FuseOptions
from stages.build_scene_template.given import GivenOptions
from stages.build_scene_template.refine import RefineOptions
from stages.build_scene_template.sfm import SfmOptions


@dataclass(frozen=True)
class Config:
    """How the scene template is built."""

    structure: SfmOptions = field(default_factory=SfmOptions)
    """Keyframes, SIFT, matching and mapping."""
    believe: AnchorOptions = field(default_factory=AnchorOptions)
    """When structure from motion is believed."""
    weights: RefineOptions = field(default_factory=RefineOptions)
    """Weights of depth, tracks and odometry."""
    fusion: FuseOptions = field(default_factory=FuseOptions)
    """Resolution and reach of the fusion."""
    own_mesh: GivenOptions = field(default_factory=GivenOptions)
    """When a mesh that the recording brings along (Polycam's) is taken in place of a fused one."""
    seed: int = 0
    """Seed of COLMAP's random choices."""


def run(task: cli.Task) -> None:
    """Build and write the template."""
    (video, frames), *others = task.per_video("frames", roles=("walkthrough",)).items()
    if others:
        log(f"several walk-throughs: {video} is used")
    clip = Clip.open(frames)
    features = arrays.open_lazily(task.per_video("features", roles=("walkthrough",))[video] / "features.npz", "features")
    config = task.config
    made, sparse, own = None, None, frames / "mesh.ply"
    if own.exists() and config.own_mesh.take:
        made = given.build(clip, features, meshes.read_ply(own), config.own_mesh, config.weights, config.fusion)
    if made is None:
        with tempfile.TemporaryDirectory() as workspace:
            made, sparse = template.build(
                clip, features, structure=config.structure, believe=config.believe, weights=config.weights,
                fusion=config.fusion, workspace=Path(workspace), seed=config.seed,
            )  # fmt: skip
    with task.create() as folder:
        normals = made.mesh.vertex_normals()
        meshes.write_ply(folder / "mesh.ply", made.mesh, nx=normals[:, 0], ny=normals[:, 1], nz=normals[:, 2])
        arrays.save(folder / "vertex_features.npz", features=made.features.astype(np.float16))
        arrays.save(
            folder / "cameras.npz", timestamp_s=clip.timestamp_s, world_from_camera=made.world_from_camera,
            intrinsics=clip.intrinsics, registered=made.registered,
        )  # fmt: skip
        (folder / "world.json").write_text(json.dumps(pictures.world(made), indent=1) + "\n")
        template.write_model(sparse, made.world_from_camera, folder / "colmap")
        qa.write(
            folder, good="walls are straight, furniture is whole, frames and renderings agree",
            bad="walls are doubled or bent, the path jumps, large parts are missing", checks=pictures.checks(made),
            pictures=pictures.pictures(made, clip),
        )  # fmt: skip


if __name__ == "__main__":
    cli.enter(__doc__, run, config=Config, reads=("frames", "features"))
