"""A stage's quality check of its own result: numbers with thresholds, pictures, and how good and bad look.

`write` puts `qa.json` and `qa/<name>.webp` into an artifact that is being made; `report` shows them.
"""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from jaxtyping import UInt8
from numpy import ndarray

from pipeline.data import images

Status = Literal["ok", "warn", "fail"]
MARKS = {"ok": "●", "warn": "▲", "fail": "■", "none": "○"}
"""Symbols of a status, readable without color; "none": no check."""


@dataclass(frozen=True)
class Check:
    """One number with its thresholds."""

    name: str
    value: float | None
    unit: str = ""
    warn: float | None = None
    """Beyond this the check warns; None never warns."""
    fail: float | None = None
    """Beyond this the check fails; None never fails."""
    better: Literal["lower", "higher"] = "lower"

    @property
    def status(self) -> Status:
        """Compare the value with its thresholds; if one of them was not measured (NaN, no value), warn."""
        limits = [limit for limit in (self.warn, self.fail) if limit is not None]
        if self.value is None or not all(map(math.isfinite, (self.value, *limits))):
            return "warn"
        sign = 1 if self.better == "lower" else -1
        if self.fail is not None and sign * self.value > sign * self.fail:
            return "fail"
        return "warn" if self.warn is not None and sign * self.value > sign * self.warn else "ok"


@dataclass(frozen=True)
class Picture:
    """One picture for the report."""

    name: str
    """File name without suffix."""
    image: UInt8[ndarray, "height width 3"]
    caption: str


def captioned(captions: Mapping[str, str], **images: UInt8[ndarray, "_ _ 3"]) -> list[Picture]:
    """Return pictures by name with their captions, in the order of the pictures."""
    return [Picture(name, image, captions[name]) for name, image in images.items()]


def write(
    folder: Path, *, good: str, bad: str, checks: Sequence[Check] = (), pictures: Sequence[Picture] = ()
) -> None:
    """Write `qa.json` and its pictures into `folder`, an artifact in the making.

    `good` and `bad` each complete the sentence "good (bad) looks like ...". Status none: without checks.
    """
    for picture in pictures:
        (folder / "qa").mkdir(exist_ok=True)
        images.write_color(folder / "qa" / f"{picture.name}.webp", picture.image)
    report = {
        "status": worst([check.status for check in checks]) if checks else "none",
        "good": good,
        "bad": bad,
        "checks": [_plain(check) for check in checks],
        "pictures": [{"file": f"qa/{picture.name}.webp", "caption": picture.caption} for picture in pictures],
    }
    (folder / "qa.json").write_text(json.dumps(report, indent=1, allow_nan=False) + "\n")


def failures(folder: Path) -> list[str]:
    """Return the names of a finished artifact's failed checks; none without `qa.json`."""
    path = folder / "qa.json"
    checks = json.loads(path.read_text())["checks"] if path.exists() else []
    return [check["name"] for check in checks if check["status"] == "fail"]


def worst(statuses: Sequence[Status]) -> Status:
    """Return the most severe of several statuses; ok if there are none."""
    return max(("ok", *statuses), key=("ok", "warn", "fail").index)


def _plain(check: Check) -> dict[str, Any]:
    measured = {key: getattr(check, key) for key in ("value", "warn", "fail")}
    known = {key: float(x) if x is not None and math.isfinite(x) else None for key, x in measured.items()}
    return {**vars(check), **known, "status": check.status}
