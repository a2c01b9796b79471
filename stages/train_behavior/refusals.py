"""Refuse at once what training would find out too late."""

from collections.abc import Mapping
from typing import Any

from pipeline.errors import InputError
from pipeline.models.behavior import Architecture
from pipeline.models.trajectories import PAST, RATE_HZ, TRAIN, BehaviorData


def refuse(config: Mapping[str, Any], data: BehaviorData, architecture: Architecture, where: str) -> None:
    """Raise REC-002 for settings of which nothing can be learned or made, BEH-001 where no window is as long as they want.

    Args:
        config: the fields of the stage's `Config`.
        data: what would be learned, with the horizon of the settings.
        architecture: of what would learn.
        where: the data stand, for messages.
    """
    pace, staged = config["training"].optimization, architecture.family != "one_stage"
    if config["reading"] == "pointwise" and not architecture.map_cells:
        raise InputError("REC-002", "the 3-D encoder makes no map", "[train_behavior]: reading", 'scene = "pillars" makes one')
    if config["export"] and not staged:
        what = "a model without goals cannot be exported: page and samplers ask for them"
        raise InputError("REC-002", what, "[train_behavior]: export", "set it to false; `make behavior-tables` judges such models")
    if staged and pace.steps <= pace.goal_steps:
        what = f"{pace.goal_steps} steps of goals leave none of {pace.steps} to paths and bodies"
        raise InputError("REC-002", what, "[train_behavior.training.optimization]: steps", "take more steps, or fewer `goal_steps`")
    if not len(data.indices(TRAIN)):
        what = f"no {(PAST + data.future) / RATE_HZ:.1f} s of uninterrupted motion to learn from"
        raise InputError("BEH-001", what, where, "film longer sessions in which the animal stays in view, or foretell less (`horizon_s`)")
