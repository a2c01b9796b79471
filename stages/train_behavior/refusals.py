"""Refuse at once what training would find out too late."""

from pipeline.behavior.model import Architecture
from pipeline.behavior.trajectories import RATE_HZ, TRAIN, BehaviorData
from pipeline.core.errors import InputError
from stages.train_behavior.config import Config


def check_settings(config: Config, data: BehaviorData, architecture: Architecture, where: str) -> None:
    """Raise REC-002 for settings that cannot be trained or exported, BEH-001 where no window is long enough.

    Args:
        config: the stage's settings.
        data: what would be learned, with the horizon of the settings.
        architecture: of what would learn.
        where: the data stand, for messages.
    """
    optimization, staged = config.training.optimization, architecture.family != "one_stage"
    if config.map_lookup == "pointwise" and not architecture.map_cells:
        raise InputError(
            "REC-002",
            "only the 2.5-D encoder makes a map",
            "[train_behavior]: map_lookup",
            'scene = "pillars" makes one',
        )
    if config.export and not staged:
        what = "a model without goals cannot be exported: page and samplers ask for them"
        raise InputError(
            "REC-002",
            what,
            "[train_behavior]: export",
            "set it to false; `make behavior-tables` judges such models",
        )
    if config.export and config.scene == "none":
        raise InputError(
            "REC-002",
            "a model without a scene encoder cannot be exported: the page shows it a scene",
            "[train_behavior]: export",
            "set it to false, or choose an encoder",
        )
    if config.export and data.rate_hz != RATE_HZ:
        raise InputError(
            "REC-002",
            f"plans of {data.rate_hz:g} frames a second cannot be played: page and simulator have {RATE_HZ}",
            "[train_behavior]: export",
            "set it to false, or leave out `rate_hz` of [slice_behavior]",
        )
    if staged and optimization.steps <= optimization.goal_steps:
        what = (
            f"{optimization.goal_steps} steps of goals leave none of {optimization.steps} to paths and bodies"
        )
        raise InputError(
            "REC-002",
            what,
            "[train_behavior.training.optimization]: steps",
            "take more steps, or fewer `goal_steps`",
        )
    if not len(data.indices(TRAIN)):
        what = f"no {(data.past + data.future) / data.rate_hz:.1f} s of uninterrupted motion to learn from"
        raise InputError(
            "BEH-001",
            what,
            where,
            "film longer sessions in which the animal stays in view, or foretell less (`horizon_s`)",
        )
