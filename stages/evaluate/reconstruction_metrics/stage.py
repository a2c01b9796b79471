"""The stage: all that precedes behavior, and what is known of the truth -> metrics, the quality page."""

from pathlib import Path

from pipeline.core import devices
from pipeline.core.videos import Video
from pipeline.data import qa
from pipeline.metrics import bars
from pipeline.metrics.metrics import Metrics
from stages.evaluate.config import Config
from stages.evaluate.reading import BuildFolders
from stages.evaluate.reconstruction_metrics import measuring

JUDGED = ("registration/", "masks/", "reconstruction/")
"""Beginnings of the metrics whose bars the quality page shows."""


def run(
    inputs: BuildFolders,
    config: Config,
    out: Path,
    *,
    device: devices.Device = "cpu",
    videos: tuple[Video, ...] = (),
) -> Metrics:
    """Measure what precedes behavior into `out`, and return the metrics."""
    measure = measuring.against_clicks if inputs.truth is None else measuring.against_truth
    metrics = measure(inputs, videos, config, device)
    metrics.write(out, "metrics.json")
    qa.write(
        out,
        good="errors of a few centimeters and of less than a degree, and masks that follow the animal",
        bad="an error far above its limit: what is made after it is no better",
        checks=bars.checks(metrics, *JUDGED),
        pictures=[
            qa.Picture(f"{kind}_{n}", image, caption)
            for kind, shown in (("chart", metrics.charts), ("view", metrics.pictures))
            for n, (caption, image) in enumerate(shown.items())
        ],
    )
    return metrics
