"""Train long-term motion: bodies at sub-goals, routes between them, poses along routes, in two-second pieces.

Reads reconstructed sessions at 30 fps (spline on positions, slerp on rotations), or simulated motion in several homes;
finds from them which parts of the body touch the scene. `stages.simulate --subgoals` makes motion with the result.
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from pipeline import cli, progress, qa
from pipeline.models.longterm import Sizes
from pipeline.models.longterm_examples import Cutting
from stages.train_longterm import learning, pictures, sources
from stages.train_longterm.training import Pace, Weights


@dataclass(frozen=True)
class Config:
    """Settings of the networks and their training."""

    sizes: Sizes = field(default_factory=Sizes)
    """Widths of the networks."""
    cutting: Cutting = field(default_factory=Cutting)
    """How examples are cut out of the motion."""
    body: Pace = field(default_factory=lambda: Pace(steps=500, batch=32))
    """Training of the bodies at sub-goals."""
    route: Pace = field(default_factory=Pace)
    """Training of RouteNet."""
    pose: Pace = field(default_factory=Pace)
    """Training of PoseNet, with RouteNet held."""
    weights: Weights = field(default_factory=Weights)
    """Terms of the losses."""
    scene: bool = True
    """Whether RouteNet and PoseNet see the scene."""
    ablations: Literal["none", "rivals", "all"] = "none"
    """Which of the networks that the tables compare with to train too."""
    point_net: str | None = None
    """Weights (safetensors, as `longterm.safetensors` names them: `layers.0.weight` ...) that every PointNet starts from."""
    smplx_model: str | None = None
    """Learn people instead: a model file of SMPL-X (needs the package smplx)."""
    smplx_motions: str | None = None
    """With it: a folder with `scene.ply` and recorded SMPL-X parameters (see `stages.train_longterm.sources.people`)."""
    seed: int = 0
    """Seed of weights, examples and batches."""


def run(task: cli.Task) -> None:
    """Read, train, show."""
    c: Config = task.config
    if c.smplx_model is not None:
        lives = sources.people(Path(c.smplx_model), Path(c.smplx_motions or ""))
    elif task.has("longterm_world"):
        lives = sources.simulated(task.input("longterm_world"))
    else:
        lives = sources.recorded(task.input("reconstruction"), task.input("behavior_data"))
    progress.log(f"{len(lives.train.stretches)} stretches of motion, {sum(map(len, lives.train.stretches)) / 1800:.1f} min at 30 fps")
    learned = learning.learn(lives.train, c, resume=task.resume)
    shown = pictures.shown(learned, lives, c.seed)
    with task.create() as folder:
        learned.model.save(folder)
        learning.write_ablations(folder, learned)
        qa.write(
            folder,
            good="routes that bend where the animal's do, bodies that stand on what is beneath them",
            bad="routes through furniture, bodies in the air or in the ground",
            checks=shown.checks,
            pictures=shown.pictures,
        )


if __name__ == "__main__":
    cli.enter(__doc__, run, config=Config, optional=("reconstruction", "behavior_data", "longterm_world"))
