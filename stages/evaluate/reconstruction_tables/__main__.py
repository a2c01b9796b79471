"""Tabulate the reconstruction against its rivals and ablations, in the shape of the paper's Table 3.

All are drawn from the held-out phone and compared with what it truly saw; the agent's root and surface points are
followed in the sessions that this phone filmed too. Writes tables.json (flat) and tables.txt (to be read).
"""

import json
from dataclasses import dataclass

import numpy as np

from pipeline import cli, qa
from pipeline.dag import RECONSTRUCTION_VARIANTS
from stages.evaluate.reading import Reconstructed
from stages.evaluate.reconstruction_tables import table
from stages.evaluate.reconstruction_tables.table import Effort


@dataclass(frozen=True)
class Config:
    """What is compared, and how sure the comparison is."""

    variants: tuple[str, ...] = RECONSTRUCTION_VARIANTS
    """Rivals and ablations whose reconstruction is there."""
    effort: Effort = Effort()
    """How much is looked at."""
    seed: int = 0
    """Of the resampling."""


def run(task: cli.Task) -> None:
    """Measure every variant and write the tables."""
    c: Config = task.config
    folders = {"ours": task.input("reconstruction"), **task.per_variant("reconstruction", c.variants)}
    templates = {name: task.input(name) for name in ("scene_template", "agent_template")}
    truth = task.input("truth") if task.has("truth") else None
    places = Reconstructed(task.per_video("frames"), **templates, reconstruction=folders["ours"], truth=truth)
    figures = table.figures(folders, places, task.videos, c.effort, np.random.default_rng(c.seed), task.device)
    with task.create() as folder:
        (folder / "tables.json").write_text(json.dumps(figures.values, indent=1, sort_keys=True) + "\n")
        (folder / "reasons.json").write_text(json.dumps(figures.reasons, indent=1, sort_keys=True) + "\n")
        (folder / "tables.txt").write_text(table.text(figures.values, tuple(folders)))
        pictures = [qa.Picture(name, image, caption) for name, (image, caption) in table.pictures(figures).items()]
        qa.write(
            folder, good="ours is ahead of every rival, for the animal and the room",
            bad="a rival is as good as ours: what it leaves out does nothing", checks=table.checks(figures.values, tuple(folders)),
            pictures=pictures,
        )  # fmt: skip


if __name__ == "__main__":
    reads = ("reconstruction", "variants", "frames", "scene_template", "agent_template")
    cli.enter(__doc__, run, config=Config, reads=reads, optional=("truth",))
