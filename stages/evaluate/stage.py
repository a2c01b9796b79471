"""The stage: the metrics of the reconstruction, and a behavior model -> all metrics, the quality page."""

from dataclasses import dataclass
from pathlib import Path

from pipeline.baselines.predictors import Ats
from pipeline.behavior.config import PlanSamplingConfig
from pipeline.behavior.scenes import Scenes
from pipeline.behavior.trajectories import BehaviorData
from pipeline.core import devices, progress
from pipeline.data import qa
from pipeline.metrics import bars
from pipeline.metrics.intervals import names_of
from pipeline.metrics.metrics import Metrics
from stages.evaluate import behavior, physical, speed
from stages.evaluate.config import Config

FOOT_SKATE = "behavior/ats/foot_slide_m_s"


@dataclass(frozen=True)
class Inputs:
    """What the stage reads."""

    reconstruction_metrics: Path
    reconstruction: Path
    behavior_data: Path
    behavior: Path


def run(inputs: Inputs, config: Config, out: Path, *, device: devices.Device = "cpu") -> Metrics:
    """Add behavior to the metrics of the reconstruction, write all into `out`, and return them."""
    metrics = Metrics.read(inputs.reconstruction_metrics)
    data = BehaviorData.load(inputs.behavior_data)
    scenes = Scenes.load(inputs.behavior_data, data.videos)
    sampling = PlanSamplingConfig()
    ours, on_cpu = (Ats.load(inputs.behavior, scenes, sampling, device=each) for each in (device, "cpu"))
    data = data.with_horizon(ours.future)
    progress.log("evaluate: behavior")
    places = scenes if ours.sampler.avoids_solid(ours.sampling) else None
    metrics.add(behavior.behavior_metrics(data, ours, config, places))
    progress.log("evaluate: penetration and foot slide")
    metrics.add(physical.physical_metrics(data, ours, inputs.reconstruction, seed=config.seed))
    metrics.add(speed.plan_metrics(data, on_cpu, config.seed, measure=config.time_plans))
    metrics.write(out, "metrics.json")
    qa.write(
        out,
        good="all simple baselines clearly worse, feet that slide no more than in recorded motion",
        bad="a simple baseline as good as ours: the capture is too easy, or the model has learned nothing",
        checks=[*better_than_baselines(metrics), *bars.checks(metrics, FOOT_SKATE)],
    )
    return metrics


def better_than_baselines(metrics: Metrics) -> list[qa.Check]:
    """Return checks that the paired difference to each baseline is below zero: the upper end of its interval,
    or its mean where one episode gives no interval.
    """
    names = [names_of(f"behavior/ats_minus_{baseline}/goal_minde_m") for baseline in bars.BASELINES]
    judged = [mean if metrics.values.get(high) is None else high for mean, _, high in names]
    return [qa.Check(name, v, "m", 0.0) for name in judged if (v := metrics.values.get(name)) is not None]
