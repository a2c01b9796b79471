"""Tabulate the registration against its ablations, in the shape of the paper's Table 1.

Every frame of every session counts; a recording that was refused counts as failed. Writes tables.json
(flat) and tables.txt (to be read).
"""

import json
from dataclasses import dataclass

import numpy as np

from pipeline import cli, qa
from pipeline.dag import REGISTRATION_VARIANTS
from stages.evaluate.registration_tables import table


@dataclass(frozen=True)
class Config:
    """What is compared, and how sure the comparison is."""

    variants: tuple[str, ...] = REGISTRATION_VARIANTS
    """Ablations whose registration is there."""
    episode_s: float = 5.0
    """Intervals draw stretches of this length again, seconds."""
    bootstrap_draws: int = 2000
    """Resamples of the intervals."""
    seed: int = 0
    """Of the resampling."""


def run(task: cli.Task) -> None:
    """Measure every variant and write the tables."""
    c: Config = task.config
    folders = {"ours": task.input("registration"), **task.per_variant("registration", c.variants)}
    frames = task.per_video("frames", roles=("walkthrough", "session"))
    truth = task.input("truth") if task.has("truth") else None
    resampling = table.Resampling(c.episode_s, c.bootstrap_draws, np.random.default_rng(c.seed))
    figures = table.figures(folders, frames, task.videos, task.input("scene_template"), truth, resampling)
    with task.create() as folder:
        (folder / "tables.json").write_text(json.dumps(figures.values, indent=1, sort_keys=True) + "\n")
        (folder / "reasons.json").write_text(json.dumps(figures.reasons, indent=1, sort_keys=True) + "\n")
        (folder / "tables.txt").write_text(table.text(figures.values, tuple(folders)))
        qa.write(
            folder, good="ours is ahead of every ablation, and the paper's order is kept",
            bad="an ablation is as good as ours: what it leaves out does nothing", checks=table.checks(figures.values, tuple(folders)),
        )  # fmt: skip


if __name__ == "__main__":
    cli.enter(__doc__, run, config=Config, reads=("registration", "variants", "frames", "scene_template"), optional=("truth",))
