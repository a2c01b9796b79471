"""Simulate the built-in animal's life in several homes, without pictures: what behaviour models are measured on.

Writes one table of motion per session, each with its home as a feature volume, in the form that `read_trajectories`
takes; the last home is unseen in training. Apart from them: scripted approaches in that home, with what the animal did.
"""

from dataclasses import dataclass

import numpy as np

from pipeline import cli, progress, qa
from stages.synthesize_capture import dwellings
from stages.synthesize_capture.lives import approaches, lives, pictures


@dataclass(frozen=True)
class Config:
    """How many lives, where, and how long."""

    seed: int = 0
    """Decides everything: homes, behaviour, the person's walks."""
    homes: int = 22
    """Homes, differently furnished; the last one is for the test."""
    sessions_per_home: int = 1
    """Sessions in each home but the last, with its loose things elsewhere each time."""
    test_sessions: int = 12
    """Sessions in the last home: more of them narrow the intervals of all that is judged there."""
    session_s: float = 150.0
    """Length of a session, seconds."""
    approaches: int = 400
    """Scripted approaches of a person in the last home, each with a twin in which the person stands still; 0 = none."""


def run(task: cli.Task) -> None:
    """Furnish the homes, let the animal live in them, and script the approaches."""
    c: Config = task.config
    homes = [dwellings.furnish_otherwise(np.random.default_rng([c.seed, 10, number])) for number in range(c.homes)]
    lived = {}
    for number in range((c.homes - 1) * c.sessions_per_home + c.test_sessions):
        rng, home = np.random.default_rng([c.seed, 11, number]), homes[min(number // c.sessions_per_home, c.homes - 1)]
        lived[f"session-{number + 1:02d}"] = lives.lived(home.rearranged(rng), rng, c.session_s)
    progress.log(f"{len(lived)} sessions of {c.session_s:g} s in {c.homes} homes")
    met = approaches.scripted(homes[-1], np.random.default_rng([c.seed, 12]), c.approaches) if c.approaches else None
    with task.create() as folder:
        (folder / "recordings").mkdir()
        (folder / "approaches").mkdir()
        for name, life in lived.items():
            lives.write(folder / "recordings" / f"{name}.npz", life)
        if met:
            approaches.write(folder / "approaches", met)
        qa.write(
            folder,
            good="an animal that rests, visits its places and runs from people, in homes that differ",
            bad="an animal that never moves or that walks through furniture",
            checks=pictures.checks(lived, met),
            pictures=pictures.pictures(lived),
        )


if __name__ == "__main__":
    cli.enter(__doc__, run, config=Config)
