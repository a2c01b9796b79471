"""Make the tables of long-term motion (Tables 1, 2 and 4 of the paper), with every variant and with and without optimisation.

On held-out sessions and an unseen home of the built-in world, where the truth is known, and on the reconstructed test
recording; then minutes through many sub-goals, and samples of the behaviour model before and after.
"""

import json
from dataclasses import dataclass, field

from pipeline import cli, progress, qa
from pipeline.models.motion_optimization import Settings
from stages.tabulate_longterm import comparison, pictures, reading, tables
from stages.tabulate_longterm.lengths import Length


@dataclass(frozen=True)
class Config:
    """How much is measured."""

    clips: int = 300
    """Short motions of each source, two by two, evenly chosen among those that end more than 0.5 m from their start."""
    optimised_clips: int = 24
    """How many of them are also optimised: of reconstructed motion ours alone, of the built-in world all methods."""
    optimisation: Settings = field(default_factory=Settings)
    """Weights and length of the optimisation."""
    minutes_s: float = 300.0
    """Length of the long motion, seconds; 0 = none."""
    subgoals: int = 20
    """Sub-goals of the long motion."""
    samples: int = 60
    """Samples of the behaviour model that are made physical; 0 = none."""
    draws: int = 2000
    """Resamples of the intervals."""
    seed: int = 0
    """Of the choice of clips, of the CVAE's codes, of samples and resampling."""


def run(task: cli.Task) -> None:
    """Measure everything and write figures and tables."""
    c: Config = task.config
    world = reading.simulated(task.input("longterm_world"), task.input("longterm_study"))
    recorded = reading.recorded(task.input("reconstruction"), task.input("behavior_data"), task.input("longterm_ablations"))
    figures = {}
    for prefix, source in (("longterm", world), ("longterm_recorded", recorded)):
        if len(source.held_out.stretches):
            figures |= comparison.figures(prefix, source, c)
    if c.minutes_s > 0:
        figures |= comparison.minutes(recorded, Length(c.minutes_s, c.subgoals), c)
    if c.samples:
        figures |= comparison.samples(recorded, task.input("behavior"), task.input("behavior_data"), c, task.device)
    text = tables.text(figures)
    progress.log(f"\n{text}")
    with task.create() as folder:
        (folder / "tables.json").write_text(json.dumps(figures, indent=1, sort_keys=True, allow_nan=False) + "\n")
        (folder / "tables.txt").write_text(text + "\n")
        qa.write(folder, **pictures.QUALITY, checks=pictures.checks(figures), pictures=pictures.pictures(figures))


if __name__ == "__main__":
    inputs = ("reconstruction", "behavior_data", "behavior", "longterm_ablations", "longterm_world", "longterm_study")
    cli.enter(__doc__, run, config=Config, reads=inputs)
