"""Measure a build: registration, localizer, masks, flow, reconstruction and behaviour, beside simple rivals.

Truth is read where it is given (the built-in capture). Elsewhere clicked correspondences (`make annotate`) stand for it,
and a held-out phone is placed by them or by registration; figures that need more are left out with the reason.
"""

import json
from dataclasses import dataclass

import numpy as np

from pipeline import cli
from stages.evaluate import evaluation, judging, reading
from stages.evaluate.behavior import Protocol

PER_VIDEO = ("frames", "masks", "flow")
ARTIFACTS = (
    "scene_template", "agent_template", "scene_localizer", "registration", "reconstruction", "splats", "behavior_data",
    "behavior",
)  # fmt: skip


@dataclass(frozen=True)
class Config:
    """Settings of the evaluation."""

    seed: int = 0
    """Of samples and resampling."""
    localizer_frames: int = 24
    """Single frames per session for the localizer and its rivals."""
    map_frames: int = 60
    """Walk-through frames that the rivals may use."""
    heldout_frames: int = 60
    """Frames of the held-out phone that are drawn."""
    surface_frames: int = 40
    """Frames per session on which the agent's surface is compared."""
    physical_windows: int = 16
    """Test windows in which penetration and foot slide are measured, of recorded and of generated motion."""
    samples: int = 16
    """Samples per window, the best of which counts."""
    trials: int = 12
    """Trials of goals."""
    plan_trials: int = 1
    """Trials of paths and bodies, which cost a hundred times more."""
    plan_windows: int = 120
    """Test windows, evenly spread, on which paths and bodies are judged; goals on all."""
    bootstrap_draws: int = 2000
    """Resamples of the intervals."""
    time_plans: bool = True
    """Measure seconds per plan; off where artifacts of two runs must be equal."""


def run(task: cli.Task) -> None:
    """Evaluate one agent's build."""
    c: Config = task.config
    folders = reading.Folders(
        **{name: task.per_video(name) for name in PER_VIDEO},
        **{name: task.input(name) for name in ARTIFACTS},
        **{name: task.input(name) if task.has(name) else None for name in ("truth", "clicks")},
    )
    effort = evaluation.Effort(c.localizer_frames, c.map_frames, c.heldout_frames, c.surface_frames, c.physical_windows, c.time_plans)
    protocol = Protocol(c.samples, c.trials, c.plan_trials, c.plan_windows, c.bootstrap_draws, c.seed)
    rng = np.random.default_rng(c.seed)
    figures = evaluation.evaluate(folders, task.videos, effort, protocol, rng, task.device)
    with task.create() as folder:
        (folder / "metrics.json").write_text(json.dumps(figures.values, indent=1, sort_keys=True) + "\n")
        (folder / "reasons.json").write_text(json.dumps(figures.reasons, indent=1, sort_keys=True) + "\n")
        judging.report_quality(folder, figures)


if __name__ == "__main__":
    cli.enter(__doc__, run, config=Config, reads=PER_VIDEO + ARTIFACTS + ("agent_localizer",), optional=("truth", "clicks"))
