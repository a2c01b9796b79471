"""The stage: a seed -> the animal's body, homes, and its motion in them at 30 fps."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.core import progress
from pipeline.data import qa
from pipeline.longterm import simulated_lives
from stages.synthesize_capture import animal
from stages.synthesize_capture.motions import motions
from stages.synthesize_capture.motions.config import Config

SESSIONS_PER_HOME = 3
"""With the home's loose things elsewhere each time; the last of each is held out."""


@dataclass(frozen=True)
class Inputs:
    """The stage reads nothing."""


def run(inputs: Inputs, config: Config, out: Path) -> None:
    """Furnish homes and let the animal live in them."""
    body = motions.body_of(animal.grow(np.random.default_rng([config.seed, 2])))
    lived = motions.lived(config.homes, SESSIONS_PER_HOME, config.session_s, config.seed)
    progress.log(f"{len(lived.sessions)} sessions of {config.session_s:g} s in {config.homes} homes")
    simulated_lives.save(out, body, lived.scenes, lived.sessions, lived.scene_of, lived.split)
    qa.write(
        out,
        good="an animal that is on its way half of the time",
        bad="an animal that never moves",
        checks=motions.checks(lived),
    )
