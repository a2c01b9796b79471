"""The stage's own judgement of the metrics that matter most."""

from pathlib import Path
from typing import Literal

from pipeline.data import qa
from pipeline.metrics.metrics import Metrics

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


def report_quality(folder: Path, metrics: Metrics) -> None:
    """Write the notes for the report; metrics that do not apply are left out."""
    checks = [
        qa.Check(name, metrics.values[name], unit, warn=limit, better=better)
        for name, unit, limit, better in LIMITS
        if metrics.values.get(name) is not None
    ]
    good = "errors of a few centimetres and of less than a degree, and all simple rivals clearly worse"
    bad = "a simple rival as good as ours: then the capture is too easy, or the model has learned nothing"
    named = (("chart", metrics.charts), ("view", metrics.pictures))
    pictures = [
        qa.Picture(f"{kind}_{n}", image, caption)
        for kind, shown in named
        for n, (caption, image) in enumerate(shown.items())
    ]
    qa.write(folder, good=good, bad=bad, checks=checks, pictures=pictures)
