"""Named metrics, each a number, or None with a reason."""

import json
import math
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Float, Shaped, UInt8

from pipeline.metrics.intervals import Interval, names_of

FAILED = "failed: "
"""Begins the reason of a metric that would be infinite, because what it measures failed too often."""


@dataclass(frozen=True)
class Metrics:
    """The content of `metrics.json` and `reasons.json`, with pictures."""

    values: dict[str, float | None] = field(default_factory=dict)
    reasons: dict[str, str] = field(default_factory=dict)
    pictures: dict[str, UInt8[np.ndarray, "height width 3"]] = field(default_factory=dict)
    """views of what was recorded and reconstructed, by caption"""
    charts: dict[str, UInt8[np.ndarray, "height width 3"]] = field(default_factory=dict)
    """drawn from numbers alone, by caption"""

    def put(self, name: str, value: float, why_unknown: str = "too few frames could be measured") -> None:
        """Record a metric; None with the given reason if it is NaN, or infinite, which is a failure."""
        if math.isfinite(value):
            self.values[name] = float(value)
        else:
            self.skip([name], (FAILED if math.isinf(value) else "") + why_unknown)

    def put_mean(self, name: str, interval: Interval) -> None:
        """Record a mean with the bounds of its 95 % interval."""
        self.put(name, interval.mean)
        for end, value in zip(names_of(name)[1:], (interval.low, interval.high), strict=True):
            self.put(end, value, "one episode alone gives no interval")

    def skip(self, names: Iterable[str], reason: str) -> None:
        """Record metrics that do not apply."""
        for name in names:
            self.values[name], self.reasons[name] = None, reason

    def add_as(self, variant: str, other: "Metrics", stage: str) -> None:
        """Take over the metrics of one variant: ``<stage>/<figure>`` becomes ``<variant>/<figure>``."""
        self.values.update({name.replace(stage, variant, 1): value for name, value in other.values.items()})
        self.reasons.update({name.replace(stage, variant, 1): why for name, why in other.reasons.items()})

    def add(self, other: "Metrics") -> None:
        """Merge other metrics; those measured there lose their reasons."""
        for name, value in other.values.items():
            if value is not None:
                self.reasons.pop(name, None)
        self.values.update(other.values)
        self.reasons.update(other.reasons)
        self.pictures.update(other.pictures)
        self.charts.update(other.charts)

    @classmethod
    def read(cls, folder: Path) -> "Metrics":
        """Read `metrics.json` and `reasons.json`."""
        return cls(*(json.loads((folder / name).read_bytes()) for name in ("metrics.json", "reasons.json")))

    def write(self, folder: Path, file: str) -> None:
        """Write values as ``file`` and the reasons for missing ones as ``reasons.json``."""
        for name, table in ((file, self.values), ("reasons.json", self.reasons)):
            (folder / name).write_text(json.dumps(table, indent=1, sort_keys=True) + "\n")


def formatted(value: float | None, form: str = ".3f") -> str:
    """Write a figure for a table; ``-`` where there is none."""
    return "-" if value is None else format(value, form)


def mean(values: Shaped[np.ndarray, "value"]) -> float:
    """Return the mean, of truth values the share; NaN when nothing was measured."""
    return float(values.mean()) if len(values) else math.nan


def median(errors: Float[np.ndarray, "error"]) -> float:
    """Return the median where failures count as infinite; NaN when nothing was measured."""
    return float(np.median(errors)) if len(errors) else math.nan


def percentile(errors: Float[np.ndarray, "error"], share: float) -> float:
    """Return a percentile (0..100) without interpolation, so that infinite failures stay infinite."""
    return float(np.percentile(errors, share, method="higher")) if len(errors) else math.nan
