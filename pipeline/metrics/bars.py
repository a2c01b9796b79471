"""Comparison of the metrics of `metrics.json` with the targets of this project.

A bar is a limit, or another metric to beat. Metrics that were not measured have a reason; those that failed
miss their bar.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

from pipeline.data.qa import Check
from pipeline.metrics.intervals import finite
from pipeline.metrics.metrics import FAILED, Metrics
from pipeline.metrics.words import SUBJECTS

Verdict = Literal["ok", "fail", "none"]
BASELINES = ("location_prior", "stand_still", "constant_velocity")


@dataclass(frozen=True)
class Bar:
    """One target."""

    metric: str
    words: str
    better: Literal["lower", "higher"]
    limit: float | str
    """a number, or the name of the metric to beat or reach"""
    unit: str = ""
    factor: float = 1.0
    """factor on that metric"""

    @property
    def sign(self) -> str:
        """Required comparison: strict against a baseline, else with equality."""
        baseline = isinstance(self.limit, str) and self.factor == 1.0
        return "≥" if self.better == "higher" else "<" if baseline else "≤"


@dataclass(frozen=True)
class Judged:
    """The result of one bar."""

    bar: Bar
    value: float | None
    limit: float | None
    verdict: Verdict
    reason: str
    """why there is no value"""


def beaten(metric: str, words: str) -> list[Bar]:
    """Return bars for our metric to be below that of every simple baseline."""
    return [
        Bar(metric, f"{words}: below {SUBJECTS[key]}", "lower", metric.replace("/ats/", f"/{key}/"), "m")
        for key in BASELINES
    ]


BARS = (
    Bar("registration/rotation_deg_median", "camera rotation error, median of all frames",
        "lower", 1.0, "deg"),
    Bar("registration/translation_m_median", "camera position error, median of all frames",
        "lower", 0.04, "m"),
    Bar("registration/videos_registered", "sessions on the map", "higher", "registration/videos_total"),
    Bar("masks/iou_mean", "overlap of masks with the true animal", "higher", 0.75),
    Bar("reconstruction/depth_acc_all", "depth within 0.1 m, seen by the held-out phone", "higher", 0.88),
    Bar("reconstruction/agent_root_m_median", "position error of the animal, median", "lower", 0.08, "m"),
    *beaten("behavior/ats/goal_minde_m", "goal error, best of 16"),
    *beaten("behavior/ats/goal_energy_score_m", "energy score of goals"),
    Bar("behavior/ats/foot_slide_m_s",
        "foot skate of generated motion: at most 1.5 times that of recorded motion",
        "lower", "behavior/recorded/foot_slide_m_s", "m/s", 1.5),
    Bar("simulator/plan_few_s", "time of a plan in few steps, one core", "lower", 1.5, "s"),
)  # fmt: skip


def judge(metrics: Mapping[str, float | None], reasons: Mapping[str, str]) -> list[Judged]:
    """Compare every bar with its metric."""
    return [_judged(bar, metrics, reasons) for bar in BARS]


def _judged(bar: Bar, metrics: Mapping[str, float | None], reasons: Mapping[str, str]) -> Judged:
    value, limit = finite(metrics.get(bar.metric)), bar.limit
    if isinstance(limit, str):
        other = finite(metrics.get(limit))
        limit = None if other is None else bar.factor * other
    if value is None or limit is None:
        reason = reasons.get(bar.metric if value is None else str(bar.limit), "not measured")
        failed = value is None and reason.startswith(FAILED)
        return Judged(bar, value, limit, "fail" if failed else "none", reason)
    holds = {"<": value < limit, "≤": value <= limit, "≥": value >= limit}[bar.sign]
    return Judged(bar, value, limit, "ok" if holds else "fail", "")


def checks(metrics: Metrics, *begin: str) -> list[Check]:
    """Return the bars of metrics whose names begin so as checks; none for what was not measured."""
    return [
        Check(row.bar.metric, row.value, row.bar.unit, row.limit, better=row.bar.better)
        for row in judge(metrics.values, metrics.reasons)
        if row.verdict != "none" and row.bar.metric.startswith(begin)
    ]


def worst(judged: Sequence[Judged]) -> Literal["ok", "fail"]:
    """Return the verdict on all bars together, ignoring those not measured."""
    return "fail" if any(row.verdict == "fail" for row in judged) else "ok"


def grouped(metrics: Mapping[str, float | None]) -> dict[str, dict[str, float | None]]:
    """Group metrics by the first part of their names."""
    groups: dict[str, dict[str, float | None]] = {}
    for name, value in sorted(metrics.items()):
        group, _, rest = name.partition("/")
        groups.setdefault(group, {})[rest or name] = finite(value)
    return groups
