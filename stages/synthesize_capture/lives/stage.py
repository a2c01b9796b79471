"""The stage: a seed -> tables of motion in many homes, and scripted approaches in the last one."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from pipeline.behavior.trajectories import PAST
from pipeline.core import progress
from pipeline.data import qa
from pipeline.data.qa import Check
from pipeline.metrics.flight import flees
from stages.synthesize_capture import dwellings
from stages.synthesize_capture.lives import approaches, lives
from stages.synthesize_capture.lives.approaches import ScriptedApproaches
from stages.synthesize_capture.lives.config import Config
from stages.synthesize_capture.lives.lives import RATE_HZ, SimulatedLife
from stages.synthesize_capture.policy import REASONS

TAKES = 5
"""Takes of a session, each begun anew from anywhere: else the animal is mostly met where it fled to."""
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
        lived[f"session-{number + 1:02d}"] = lives.lived(
            dwellings.rearranged(home, rng), rng, config.session_s, TAKES
        )
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
        checks=checks(lived, met),
    )


def checks(lived: dict[str, SimulatedLife], met: ScriptedApproaches) -> list[Check]:
    """Judge the lives."""
    reason = np.concatenate([life.reason for life in lived.values()])
    inside = np.concatenate([_inside(life) for life in lived.values()])
    minutes = sum(len(life.timestamp_s) for life in lived.values()) / RATE_HZ / 60
    shares = [
        Check(f"share of time: {name}", float((reason == code).mean()), "")
        for code, name in enumerate(REASONS)
    ]
    root = met.world_from_agent[..., :3, 3]
    walked, stood = flees(root[:, :, PAST:], root[:, :, PAST - 1], met.observer[:, :, -1]).mean(1).tolist()
    return [
        Check("minutes in all", minutes, "min", 1, 0.5, "higher"),
        *shares,
        Check("root inside something solid", float(inside.mean()), "share", 0.01, 0.05),
        Check("flees from a walking person", walked, "share", 0.6, 0.4, "higher"),
        Check("flees from a standing one", stood, "share", 0.2),
    ]


def _inside(life: SimulatedLife) -> Float[np.ndarray, "frame"]:
    voxel, known = life.volume.voxel(life.world_from_agent[:, :3, 3])
    return (life.volume.occupancy[tuple(voxel.T)] == 1) | ~known
