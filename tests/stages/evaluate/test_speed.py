"""Plans are timed on one CPU thread, independently of the device of the evaluation."""

from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from pipeline.baselines.predictors import Ats
from pipeline.behavior.config import PlanSamplingConfig
from pipeline.behavior.scenes import Scenes
from pipeline.behavior.trajectories import BehaviorData
from pipeline.metrics import bars
from pipeline.metrics.metrics import Metrics
from stages.evaluate import speed, stage
from stages.evaluate.config import Config

DATA = SimpleNamespace(
    start=np.zeros(1),
    windows=lambda index: (None, None),
    videos=(),
    with_horizon=lambda future: SimpleNamespace(future=future),
)


@dataclass(frozen=True)
class Watched:
    """Records the number of threads of each call."""

    device: str = "cpu"
    future: int = 40
    sampler: SimpleNamespace = field(default_factory=SimpleNamespace)
    sampling: PlanSamplingConfig = PlanSamplingConfig()
    threads: list[int] = field(default_factory=list)

    def sample(self, context: None, count: int, rng: np.random.Generator) -> None:
        self.threads.append(torch.get_num_threads())


def test_plans_are_timed_with_one_thread():
    before, ours = torch.get_num_threads(), Watched()
    torch.set_num_threads(2)
    values = speed.plan_metrics(DATA, ours, 0, measure=True).values
    assert torch.get_num_threads() == 2
    torch.set_num_threads(before)
    assert set(ours.threads) == {1} and values["simulator/plan_few_s"] >= 0


@pytest.mark.parametrize("corrected", [True, False])
def test_devices_horizon_and_corrections_are_those_of_the_model(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, corrected: bool
):
    asked = {}

    def nothing(*given: object, **named: object) -> Metrics:
        return Metrics()

    def loaded(*given: object, device: str) -> Watched:
        return Watched(device, sampler=SimpleNamespace(avoids_solid=lambda sampling: corrected))

    def remembers(room: str):
        def metrics(data: SimpleNamespace, ours: Watched, *given: object, **named: object) -> Metrics:
            assert data.future == ours.future
            assert room != "behavior" or (given[-1] is not None) == corrected, "baselines as ours"
            asked[room] = ours.device
            return Metrics()

        return metrics

    for owner, name, double in (
        (BehaviorData, "load", lambda folder: DATA),
        (Scenes, "load", nothing),
        (Ats, "load", loaded),
        (Metrics, "read", nothing),
        (stage.behavior, "behavior_metrics", remembers("behavior")),
        (stage.physical, "physical_metrics", remembers("physical")),
        (stage.speed, "plan_metrics", remembers("speed")),
    ):
        monkeypatch.setattr(owner, name, double)
    stage.run(stage.Inputs(*[tmp_path] * 4), Config(), tmp_path, device="cuda")
    assert asked == {"behavior": "cuda", "physical": "cuda", "speed": "cpu"}


def test_feet_that_slide_more_than_in_recorded_motion_are_a_warning():
    def check(planned, recorded):
        values = {"behavior/ats/foot_slide_m_s": planned, "behavior/recorded/foot_slide_m_s": recorded}
        return bars.checks(Metrics(values), stage.FOOT_SKATE)

    assert [each.status for each in check(0.42, 0.21) + check(0.044, 0.030)] == ["warn", "ok"]
    assert check(None, None) == [], "no window"


def test_baselines_that_may_be_as_good_are_a_warning():
    def statuses(mean, high):
        names = [f"behavior/ats_minus_{baseline}/goal_minde_m" for baseline in bars.BASELINES]
        values = {name: mean for name in names} | {f"{name}_ci95_high": high for name in names}
        return {each.status for each in stage.better_than_baselines(Metrics(values))}

    assert statuses(-0.2, -0.1) == {"ok"} and statuses(-0.2, 0.1) == {"warn"}
    assert statuses(-0.2, None) == {"ok"} and statuses(0.2, None) == {"warn"}, "a single episode"
    assert statuses(None, None) == set(), "no window"
