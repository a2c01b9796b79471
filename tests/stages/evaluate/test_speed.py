"""A plan is timed on one core, wherever all else is computed."""

from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from pipeline.models.behavior import Sampling
from pipeline.models.predictors import Ats
from pipeline.models.scenes import Scenes
from pipeline.models.trajectories import BehaviorData
from stages.evaluate import evaluation, speed
from stages.evaluate.figures import Figures

DATA = SimpleNamespace(start=np.zeros(1), windows=lambda index: (None, None), videos=())


@dataclass(frozen=True)
class Watched:
    """Remembers with how many threads it was asked."""

    device: str = "cpu"
    sampling: Sampling = Sampling()
    threads: list[int] = field(default_factory=list)

    def sample(self, context: None, count: int, rng: np.random.Generator) -> None:
        self.threads.append(torch.get_num_threads())


def test_plans_are_timed_with_one_thread():
    before, ours = torch.get_num_threads(), Watched()
    torch.set_num_threads(2)
    values = speed.plan_figures(DATA, ours, 0, measure=True).values
    assert torch.get_num_threads() == 2
    torch.set_num_threads(before)
    assert set(ours.threads) == {1} and values["simulator/plan_few_s"] >= 0


def test_plans_are_timed_on_the_cpu(monkeypatch: pytest.MonkeyPatch):
    asked = {}

    def nothing(*given: object, **named: object) -> Figures:
        return Figures()

    def loaded(*given: object, device: str) -> Watched:
        return Watched(device)

    def remembers(room: str):
        def figures(data: object, ours: Watched, *given: object, **named: object) -> Figures:
            asked[room] = ours.device
            return Figures()

        return figures

    for owner, name, double in (
        (BehaviorData, "load", lambda folder: DATA),
        (Scenes, "load", nothing),
        (Ats, "load", loaded),
        (evaluation, "_against_clicks", nothing),
        (evaluation.behavior, "behavior_figures", remembers("behavior")),
        (evaluation.physical, "physical_figures", remembers("physical")),
        (evaluation.speed, "plan_figures", remembers("speed")),
    ):
        monkeypatch.setattr(owner, name, double)
    folders = SimpleNamespace(truth=None, behavior=Path(), behavior_data=Path(), reconstruction=Path())
    protocol, effort = SimpleNamespace(seed=0), SimpleNamespace(physical_windows=1, time_plans=True)
    evaluation.evaluate(folders, (), effort, protocol, np.random.default_rng(0), "cuda")
    assert asked == {"behavior": "cuda", "physical": "cuda", "speed": "cpu"}
