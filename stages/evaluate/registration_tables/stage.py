"""The stage: registrations of all variants -> tables.json, tables.txt, the quality page."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.core.videos import Video
from pipeline.data import qa
from pipeline.metrics.metrics import Metrics
from stages.evaluate.registration_tables import table
from stages.evaluate.registration_tables.config import Config


@dataclass(frozen=True)
class Inputs:
    """What the stage reads."""

    registration: Path
    """Of the default settings."""
    variants: Mapping[str, Path]
    """`registration` of every ablation."""
    frames: Mapping[str, Path]
    """`frames/<id>` of the walk-through and all sessions."""
    scene_template: Path
    truth: Path | None = None
    """The built-in capture's truth; None for a user's own recordings."""


def run(inputs: Inputs, config: Config, out: Path, *, videos: tuple[Video, ...] = ()) -> Metrics:
    """Measure every variant and write the tables."""
    folders = {"ours": inputs.registration, **inputs.variants}
    rng = np.random.default_rng(config.seed)
    metrics = table.metrics(folders, inputs.frames, videos, inputs.scene_template, inputs.truth, rng)
    metrics.write(out, "tables.json")
    (out / "tables.txt").write_text(table.text(metrics.values, tuple(folders)))
    qa.write(
        out,
        good="ours is ahead of every ablation, and in the paper's order",
        bad="an ablation is as good as ours: what it leaves out does nothing",
        checks=table.checks(metrics.values, tuple(folders)),
    )
    return metrics
