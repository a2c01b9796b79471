"""Simulate the built-in animal's life in several homes, without pictures: what behaviour models are measured on.

Writes one table of motion per session, each with its home as a feature volume, in the form that `read_trajectories`
takes; the last homes are unseen in training. Apart from them: scripted approaches in the very last, with what the animal did.
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
    homes: int = 24
    """Homes to learn from, differently furnished."""
    sessions_per_home: int = 1
    """Sessions in each of them, with its loose things elsewhere each time."""
    test_homes: int = 2
    """Homes that training never sees."""
    test_sessions: int = 8
    """Sessions in each of those: more of them narrow the intervals of all that is judged there."""
    session_s: float = 150.0
    """Length of a session, seconds."""
    takes: int = 5
    """Takes of a session, each begun anew from anywhere in the home: else the animal is mostly met in the corners that it fled to."""
    approaches: int = 400
    """Scripted approaches of a person in the last home, each with a twin in which the person stands still; 0 = none."""


def run(task: cli.Task) -> None:
    """Furnish the homes, let the animal live in them, and script the approaches."""
    c: Config = task.config
    homes = [dwellings.furnish_otherwise(np.random.default_rng([c.seed, 10, number])) for number in range(c.homes + c.test_homes)]
    sessions = [home for home in homes[: c.homes] for _ in range(c.sessions_per_home)]
    sessions += [home for home in homes[c.homes :] for _ in range(c.test_sessions)]
    lived = {}
    for number, home in enumerate(sessions):
        rng = np.random.default_rng([c.seed, 11, number])
        lived[f"session-{number + 1:02d}"] = lives.lived(home.rearranged(rng), rng, c.session_s, c.takes)
    progress.log(f"{len(lived)} sessions of {c.session_s:g} s in {len(homes)} homes")
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
