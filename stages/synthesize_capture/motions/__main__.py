"""Simulate the built-in animal's motion in several homes, without pictures: what long-term motion is measured on.

Writes its body, the surface of every home as it was in each session, and its motion at 30 fps. The last home is never
learned from, nor is the last session of each other home.
"""

from dataclasses import dataclass

import numpy as np

from pipeline import cli, progress, qa
from pipeline.models import simulated_lives
from stages.synthesize_capture import animal
from stages.synthesize_capture.motions import motions


@dataclass(frozen=True)
class Config:
    """How much motion, in how many homes."""

    seed: int = 0
    """Decides everything: homes, the animal's life, the person's walks."""
    homes: int = 9
    """Homes, differently furnished; the last one is unseen in training."""
    sessions_per_home: int = 3
    """Sessions in each home, with its loose things elsewhere each time; the last of each is held out."""
    session_s: float = 200.0
    """Length of a session, seconds."""


def run(task: cli.Task) -> None:
    """Furnish homes and let the animal live in them."""
    c: Config = task.config
    body = motions.body_of(animal.grow(np.random.default_rng([c.seed, 2])))
    lived = motions.lived(c.homes, c.sessions_per_home, c.session_s, c.seed)
    progress.log(f"{len(lived.sessions)} sessions of {c.session_s:g} s in {c.homes} homes")
    with task.create() as folder:
        simulated_lives.save(folder, body, lived.scenes, lived.sessions, lived.scene_of, lived.split)
        qa.write(
            folder,
            good="an animal that is on its way half of the time",
            bad="an animal that never moves",
            checks=motions.checks(lived),
        )


if __name__ == "__main__":
    cli.enter(__doc__, run, config=Config)
