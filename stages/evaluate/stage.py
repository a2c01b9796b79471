"""The stage: a finished build and what is known of the truth -> metrics, reasons, the quality page."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from pipeline.core import devices
from pipeline.core.videos import Video
from pipeline.data import qa
from pipeline.metrics.metrics import Metrics
from stages.evaluate import measuring
from stages.evaluate.config import Config
from stages.evaluate.reading import BuildFolders

LIMITS: tuple[tuple[str, str, float, Literal["lower", "higher"]], ...] = (
    ("registration/rotation_deg_median", "deg", 1.0, "lower"),
    ("registration/translation_m_median", "m", 0.04, "lower"),
    ("masks/iou_mean", "", 0.75, "higher"),
    ("reconstruction/depth_acc_all", "", 0.88, "higher"),
    ("reconstruction/agent_root_m_median", "m", 0.08, "lower"),
    ("behavior/ats_minus_stand_still/goal_minde_m", "m", 0.0, "lower"),
    ("behavior/ats_minus_location_prior/goal_minde_m", "m", 0.0, "lower"),
    ("behavior/ats_minus_constant_velocity/goal_minde_m", "m", 0.0, "lower"),
)
"""What the quality page judges: figure, unit, the value that is good enough, which way is better."""


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
    qa.write(
        out,
        good="errors of a few centimetres and of less than a degree, and all simple rivals clearly worse",
        bad="a simple rival as good as ours: then the capture is too easy, or the model has learned nothing",
        checks=[
            qa.Check(name, metrics.values[name], unit, warn=limit, better=better)
            for name, unit, limit, better in LIMITS
            if metrics.values.get(name) is not None
        ],
        pictures=[
            qa.Picture(f"{kind}_{n}", image, caption)
            for kind, shown in (("chart", metrics.charts), ("view", metrics.pictures))
            for n, (caption, image) in enumerate(shown.items())
        ],
    )
    return metrics
