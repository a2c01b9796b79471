"""Validation of settings and data before training."""

from pipeline.behavior.model import Architecture
from pipeline.behavior.trajectories import RATE_HZ, TRAIN, BehaviorData
from pipeline.core.errors import InputError
from stages.train_behavior.config import Config


def check_settings(config: Config, data: BehaviorData, architecture: Architecture, where: str) -> None:
    """Raise REC-002 for settings that cannot be trained or exported, BEH-001 where no window is long enough.

    Args:
        config: the stage's settings.
        data: the training data, with the horizon of the settings.
        architecture: of the model.
        where: path of the data, for messages.
    """
    optimization, staged = config.training.optimization, architecture.family != "one_stage"
    goal_steps, steps, table = optimization.goal_steps, optimization.steps, "[train_behavior]"
    off = "set it to false"
    if config.export and not staged:
        what = "a model without goals cannot be exported: page and samplers ask for them"
        remedy = f"{off}; `make behavior-tables` judges such models"
        raise InputError("REC-002", what, f"{table}: export", remedy)
    if config.export and config.scene == "none":
        what = "a model without a scene encoder cannot be exported: the page shows it a scene"
        raise InputError("REC-002", what, f"{table}: export", f"{off}, or choose an encoder")
    if config.export and data.rate_hz != RATE_HZ:
        what = (
            f"plans of {data.rate_hz:g} frames a second cannot be played: page and simulator have {RATE_HZ}"
        )
        remedy = f"{off}, or leave out `rate_hz` of [slice_behavior]"
        raise InputError("REC-002", what, f"{table}: export", remedy)
    if staged and steps <= goal_steps:
        what = f"{goal_steps} steps of goals leave none of {steps} to paths and bodies"
        remedy = "take more steps, or fewer `goal_steps`"
        raise InputError("REC-002", what, "[train_behavior.training.optimization]: steps", remedy)
    if not len(data.indices(TRAIN)):
        what = f"no {(data.past + data.future) / data.rate_hz:.1f} s of uninterrupted motion to learn from"
        remedy = "film longer sessions in which the animal stays in view, or foretell less (`horizon_s`)"
        raise InputError("BEH-001", what, where, remedy)
