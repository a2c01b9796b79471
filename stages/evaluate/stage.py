"""The stage: a finished build and what is known of the truth -> metrics, reasons for what is missing, the
quality page.
"""

from dataclasses import dataclass
from pathlib import Path

from pipeline.core import devices
from pipeline.core.videos import Video
from pipeline.metrics.metrics import Metrics
from stages.evaluate import judging, measuring
from stages.evaluate.config import Config
from stages.evaluate.reading import BuildFolders


@dataclass(frozen=True, kw_only=True)
class Inputs(BuildFolders):
    """What the stage reads."""


def run(
    inputs: Inputs,
    config: Config,
    out: Path,
    *,
    device: devices.Device = "cpu",
    videos: tuple[Video, ...] = (),
) -> Metrics:
    """Measure one agent's build into `out`, and return the metrics."""
    metrics = measuring.evaluate(inputs, videos, config, device)
    metrics.write(out, "metrics.json")
    judging.report_quality(out, metrics)
    return metrics
