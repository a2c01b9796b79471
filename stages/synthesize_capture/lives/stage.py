"""The stage: a seed -> tables of motion in many homes, and scripted approaches in the last one."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.core import progress
from pipeline.data import qa
from stages.synthesize_capture import dwellings
from stages.synthesize_capture.lives import approaches, lives, pictures
from stages.synthesize_capture.lives.config import Config

TAKES = 5
"""Takes of a session, each begun anew from anywhere in the home: else the animal is mostly met where it fled
to."""
APPROACHES = 400
"""Scripted approaches of a person in the last home, each with a twin in which the person stands still: the
interval of a share is then 5 points wide."""


@dataclass(frozen=True)
class Inputs:
    """The stage reads nothing."""


def run(inputs: Inputs, config: Config, out: Path) -> None:
    """Furnish the homes, let the animal live in them, and script the approaches."""
    homes = [
        dwellings.furnish_otherwise(np.random.default_rng([config.seed, 10, number]))
        for number in range(config.homes + config.test_homes)
    ]
    sessions = [home for home in homes[: config.homes] for _ in range(config.sessions_per_home)]
    sessions += [home for home in homes[config.homes :] for _ in range(config.test_sessions)]
    lived = {}
    for number, home in enumerate(sessions):
        rng = np.random.default_rng([config.seed, 11, number])
        lived[f"session-{number + 1:02d}"] = lives.lived(home.rearranged(rng), rng, config.session_s, TAKES)
    progress.log(f"{len(lived)} sessions of {config.session_s:g} s in {len(homes)} homes")
    met = approaches.scripted(homes[-1], np.random.default_rng([config.seed, 12]), APPROACHES)
    (out / "recordings").mkdir()
    (out / "approaches").mkdir()
    for name, life in lived.items():
        lives.write(out / "recordings" / f"{name}.npz", life)
    approaches.write(out / "approaches", met)
    qa.write(
        out,
        good="an animal that rests, visits its places and runs from people, in homes that differ",
        bad="an animal that never moves or that walks through furniture",
        checks=pictures.checks(lived, met),
        pictures=pictures.pictures(lived),
    )
