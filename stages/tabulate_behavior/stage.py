"""The stage: trained models and their scores -> the tables."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from pipeline.baselines.predictors import Ats
from pipeline.behavior.config import PlanSamplingConfig
from pipeline.behavior.scenes import Scenes
from pipeline.behavior.trajectories import BehaviorData
from pipeline.core import devices, progress
from pipeline.data import npz, qa
from stages.tabulate_behavior import chaining, pictures, printing, reading, tables, untrained
from stages.tabulate_behavior.config import Config

OURS = "ats"
"""The unchanged method, with which all others are compared."""


@dataclass(frozen=True)
class Inputs:
    """What the stage reads."""

    behavior_data: Path
    """Trajectories, windows and scenes."""
    behavior_trials: Mapping[str, Path]
    """Trained models, by `<method>-<seed>`."""
    behavior_scores: Mapping[str, Path]
    """Their scores, likewise."""


def run(inputs: Inputs, config: Config, out: Path, *, device: devices.Device = "cpu") -> None:
    """Gather the scores and write the tables."""
    scores, curves = {}, {}
    for method in config.methods:
        trials = [f"{method}-{seed}" for seed in range(config.seeds)]
        scores[method] = reading.stacked([inputs.behavior_scores[trial] for trial in trials])
        curves[method] = reading.curves([inputs.behavior_trials[trial] for trial in trials])
    data = BehaviorData.load(inputs.behavior_data).with_horizon(scores[OURS].future)
    scenes = Scenes.load(inputs.behavior_data, data.videos)
    ats = Ats.load(inputs.behavior_trials[f"{OURS}-0"], scenes, PlanSamplingConfig(), device=device)
    places = scenes if ats.sampler.avoids_solid(ats.sampling) else None
    scores |= untrained.scores(data, places, scores[OURS], trials=config.trials, seed=config.seed)
    figures = tables.figures(scores, OURS, seed=config.seed) | tables.plateaus(curves)
    if config.rollouts:
        figures |= chaining.figures(
            ats, data, scenes, count=config.rollouts, seconds=config.rollout_s, seed=config.seed
        )
    text = printing.tables(figures, tuple(scores), scores[OURS].samples)
    progress.log(f"\n{text}")
    (out / "tables.json").write_text(json.dumps(figures, indent=1, sort_keys=True) + "\n")
    (out / "tables.txt").write_text(text + "\n")
    kinds = ("goal_window", "plan_window")
    windows = {f"{name}/{kind}": getattr(each, kind) for name, each in scores.items() for kind in kinds}
    npz.save(out / "windows.npz", compress=False, **windows)
    qa.write(
        out,
        good="ours ahead of every baseline, intervals apart",
        bad="curves that still fall: training was too short to compare methods",
        checks=pictures.checks(figures, OURS),
        pictures=pictures.pictures(curves),
    )
