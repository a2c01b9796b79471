"""Make the tables of the behaviour methods: every method with several seeds, judged on the same windows.

Writes flat figures (`tables.json`), the tables as text, and the exact windows. Intervals of 95 % are drawn over training
seeds and over episodes of the test recordings.
"""

import json
from dataclasses import dataclass

from pipeline import cli, progress, qa
from pipeline.files import arrays
from pipeline.models.behavior import Sampling
from pipeline.models.predictors import Ats
from pipeline.models.scenes import Scenes
from pipeline.models.trajectories import BehaviorData
from pipeline.recipes import OURS
from stages.tabulate_behavior import chaining, pictures, printing, reading, tables, untrained


@dataclass(frozen=True)
class Config:
    """Which methods, and how they are compared."""

    methods: tuple[str, ...] = (
        "ats", "gaussian", "one_stage", "world", "no_observer", "no_scene", "no_past", "concatenation", "horizon_4_0", "horizon_7_2",
    )  # fmt: skip
    """Trained methods: variants in `agents/variants/`, of which `ats` changes nothing."""
    seeds: int = 5
    """Trainings of each method."""
    samples: int = 16
    """Samples per window of the rivals that need no training; as many as `score_behavior` draws."""
    trials: int = 12
    """Trials of these rivals."""
    draws: int = 2000
    """Resamples of the intervals."""
    rollouts: int = 20
    """Lives that the first trained model is let live; 0 = none."""
    rollout_s: float = 300.0
    """Length of each, seconds."""
    seed: int = 0
    """Of samples and resampling."""


def run(task: cli.Task) -> None:
    """Gather the scores and write the tables."""
    c: Config = task.config
    trials = {method: [f"{method}-{seed}" for seed in range(c.seeds)] for method in c.methods}
    names = [trial for each in trials.values() for trial in each]
    scores, models = task.per_trial("behavior_scores", names), task.per_trial("behavior_trials", names)
    found = {method: reading.stacked([scores[trial] for trial in each]) for method, each in trials.items()}
    curves = {method: reading.curves([models[trial] for trial in each]) for method, each in trials.items()}
    data = BehaviorData.load(task.input("behavior_data"))
    found |= untrained.scores(data, found[OURS], samples=c.samples, trials=c.trials, seed=c.seed)
    figures = tables.figures(found, OURS, draws=c.draws, seed=c.seed) | tables.plateaus(curves)
    if c.rollouts:
        scenes = Scenes.load(task.paths["behavior_data"], data.videos)
        ats = Ats.load(models[f"{OURS}-0"], scenes, Sampling(), device=task.device)
        figures |= chaining.figures(ats, data, scenes, count=c.rollouts, seconds=c.rollout_s, seed=c.seed)
    text = printing.tables(figures, tuple(found))
    progress.log(f"\n{text}")
    with task.create() as folder:
        (folder / "tables.json").write_text(json.dumps(figures, indent=1, sort_keys=True) + "\n")
        (folder / "tables.txt").write_text(text + "\n")
        arrays.save(folder / "windows.npz", **reading.windows(found))
        pages = {"good": "ours ahead of every rival, intervals apart", "bad": "curves that still fall: then nothing can be said yet"}
        qa.write(folder, **pages, checks=pictures.checks(figures, OURS), pictures=pictures.pictures(curves))


if __name__ == "__main__":
    cli.enter(__doc__, run, config=Config, reads=("behavior_data", "behavior_trials", "behavior_scores"))
