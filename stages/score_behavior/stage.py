"""The stage: one trained model -> its scores on every test window."""

from dataclasses import dataclass
from pathlib import Path

from pipeline.baselines.predictors import Ats
from pipeline.behavior import model as behavior
from pipeline.behavior.config import PlanSamplingConfig
from pipeline.behavior.scenes import Scenes
from pipeline.behavior.trajectories import TEST, BehaviorData
from pipeline.core import devices, progress
from pipeline.core.errors import InputError
from pipeline.data import npz
from stages.score_behavior import approaches, protocols
from stages.score_behavior.config import Config

REPORTED = ("end_to_end/goal_minde_m", "end_to_end/path_minade_m", "truth_fed/path_minade_m")
"""Scores whose means are logged."""


@dataclass(frozen=True)
class Inputs:
    """What the stage reads."""

    behavior_data: Path
    """Trajectories, windows and scenes."""
    behavior_trials: Path
    """The trained model."""
    approaches: Path | None = None
    """Scripted approaches in a home that training never saw."""


def run(inputs: Inputs, config: Config, out: Path, *, device: devices.Device = "cpu") -> None:
    """Score one trained model.

    Raises BEH-004 without a test window, REC-002 where approaches have another rate than the model.
    """
    architecture = behavior.load(inputs.behavior_trials)[0]
    data = BehaviorData.load(inputs.behavior_data).with_horizon(architecture.future)
    if not len(data.indices(TEST)):
        remedy = f"record a session for the test, {(data.past + data.future) / data.rate_hz:g} s or longer"
        raise InputError("BEH-004", "there is no test window", str(inputs.behavior_data), remedy)
    scenes = Scenes.load(inputs.behavior_data, data.videos)
    ats = Ats.load(inputs.behavior_trials, scenes, PlanSamplingConfig(), device=device)
    scores = protocols.scores(ats, data, architecture.family, config)
    if inputs.approaches is not None and (inputs.approaches / "approaches.npz").is_file():
        recorded = approaches.read(inputs.approaches)
        approaches.check_rate(recorded, data, str(inputs.approaches))
        scores |= approaches.flight_shares(ats, recorded, config.approach_samples, config.seed)
    means = (f"{name} {scores[name].mean():.3f}" for name in REPORTED if name in scores)
    progress.log(", ".join(means))
    npz.save(out / "scores.npz", compress=False, **scores)
