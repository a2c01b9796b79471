"""Measure long-term motion against its variants, and write figures and tables."""

import json
from dataclasses import dataclass
from pathlib import Path

from pipeline.core import devices, progress
from pipeline.data import qa
from stages.tabulate_longterm import comparison, pictures, reading, tables
from stages.tabulate_longterm.config import Config
from stages.tabulate_longterm.lengths import LongMotionLength


@dataclass(frozen=True)
class Inputs:
    """Artifacts: reconstructed and simulated motion, and what was learned from each."""

    reconstruction: Path
    behavior_data: Path
    behavior: Path
    longterm_ablations: Path
    longterm_world: Path
    longterm_study: Path


def run(
    inputs: Inputs, config: Config, out: Path, *, device: devices.Device = "cpu"
) -> dict[str, float | None]:
    """Write `tables.json` and `tables.txt`; return the figures, None where nothing can be measured."""
    world = reading.simulated(inputs.longterm_world, inputs.longterm_study)
    recorded = reading.recorded(inputs.reconstruction, inputs.behavior_data, inputs.longterm_ablations)
    figures: dict[str, float | None] = {}
    for prefix, source in (("longterm", world), ("longterm_recorded", recorded)):
        if len(source.held_out.stretches):
            figures |= comparison.figures(prefix, source, config)
    if config.minutes_s > 0:
        length = LongMotionLength(config.minutes_s, config.subgoals)
        figures |= comparison.minutes(recorded, length, config)
    if config.samples:
        figures |= comparison.samples(recorded, inputs.behavior, inputs.behavior_data, config, device)
    text = tables.text(figures)
    progress.log(f"\n{text}")
    (out / "tables.json").write_text(json.dumps(figures, indent=1, sort_keys=True, allow_nan=False) + "\n")
    (out / "tables.txt").write_text(text + "\n")
    checks, shown = pictures.checks(figures), pictures.pictures(figures)
    qa.write(out, **pictures.QUALITY, checks=checks, pictures=shown)
    return figures
