"""Measure long-term motion against its variants, and write figures and tables."""

import json
from dataclasses import dataclass
from pathlib import Path

from pipeline.behavior.trajectories import BehaviorData
from pipeline.core import devices, progress
from pipeline.data import qa
from pipeline.longterm import simulated_lives
from pipeline.longterm.examples import reconstructed_split
from stages.tabulate_longterm import bars, comparison, lengths, reading, samples, tables
from stages.tabulate_longterm.config import Config


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
    world = reading.with_models(simulated_lives.load(inputs.longterm_world), inputs.longterm_study)
    data = BehaviorData.load(inputs.behavior_data)
    split = reconstructed_split(inputs.reconstruction, data)
    recorded = reading.with_models(split, inputs.longterm_ablations, data)
    figures: dict[str, float | None] = {}
    for prefix, source in (("longterm", world), ("longterm_recorded", recorded)):
        figures |= comparison.figures(prefix, source, config)
    if config.minutes_s > 0:
        figures |= lengths.figures(recorded, config)
    if config.samples:
        figures |= samples.figures(recorded, inputs.behavior, inputs.behavior_data, config, device)
    text = tables.text(figures)
    progress.log(f"\n{text}")
    (out / "tables.json").write_text(json.dumps(figures, indent=1, sort_keys=True, allow_nan=False) + "\n")
    (out / "tables.txt").write_text(text + "\n")
    qa.write(
        out,
        good="ours ahead of every baseline, and physical after the optimization at little more error",
        bad="a baseline ahead, feet that slide, bodies inside furniture",
        checks=bars.checks(figures),
    )
    return figures
