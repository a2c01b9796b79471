"""Train a localizer from rendered random views of a template.

target = "scene": the room's template and frames of the walk-through; target = "agent": the canonical
animal from all around. Views are drawn with changing light, blur, noise and occluders; what it
has not seen measures the error and calibrates the uncertainty. Writes localizer.safetensors and
localizer.json.
"""

import json
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from pipeline import cli, qa
from pipeline.files import arrays, meshes
from pipeline.files.clips import Clip
from pipeline.models import localizer as model
from stages.train_localizer import pictures, training
from stages.train_localizer.training import AgentOptions, Options


@dataclass(frozen=True)
class Config:
    """Which localizer is trained, and how."""

    target: Literal["scene", "agent"] = "scene"
    """What is localised against: the room or the animal."""
    kind: model.Kind = "bank"
    """bank: nearest neighbours among patches of rendered views; coordinates: a network tells each patch its point of the
    map; regression: a network tells the pose at once, as in the paper.
    """
    scene: Options = field(default_factory=Options)
    """The scene's localizer: number of views, scale of the pictures, how queries are answered."""
    agent: AgentOptions = field(default_factory=AgentOptions)
    """The same for the agent's."""
    seed: int = 0
    """Seed of views, noise and RANSAC."""


def run(task: cli.Task) -> None:
    """Train, measure and write the localizer."""
    rng = np.random.default_rng(task.config.seed)
    if task.config.target == "scene":
        template = task.input("scene_template")
        clip = Clip.open(next(iter(task.per_video("frames", roles=("walkthrough",)).values())))
        walk = arrays.load(template / "cameras.npz", ("world_from_camera",))["world_from_camera"]
        floor_m = json.loads((template / "world.json").read_text())["floor"]
        found, held = training.train_scene(
            meshes.read_ply(template / "mesh.ply"), walk, floor_m, clip, task.config.scene, rng, task.config.kind
        )
    else:
        mesh = meshes.read_ply(task.input("agent_template") / "agent.ply")
        found, held = training.train_agent(mesh, task.config.agent, rng, task.config.kind)
    with task.create() as folder:
        model.save(folder, found, pictures.report(held, task.config.target))
        qa.write(
            folder,
            good="held-out renders are answered within a degree or two, wrong answers get low probabilities",
            bad="the histogram has its weight on the right, or confident answers are wrong",
            checks=pictures.checks(held, task.config.target), pictures=pictures.pictures(held, found),
        )  # fmt: skip


if __name__ == "__main__":
    cli.enter(__doc__, run, config=Config, optional=("scene_template", "agent_template", "frames"))
