"""The stage: reconstructions of all variants -> tables.json, tables.txt, the quality page."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.core import devices
from pipeline.core.videos import Video
from pipeline.data import qa
from pipeline.metrics.lpips import Lpips
from pipeline.metrics.metrics import Metrics
from stages.evaluate.reading import Reconstructed
from stages.evaluate.reconstruction_tables import table
from stages.evaluate.reconstruction_tables.config import Config


@dataclass(frozen=True, kw_only=True)
class Inputs(Reconstructed):
    """What the stage reads."""

    variants: Mapping[str, Path]
    """`reconstruction` of every baseline and ablation."""


def run(
    inputs: Inputs,
    config: Config,
    out: Path,
    *,
    device: devices.Device = "cpu",
    videos: tuple[Video, ...] = (),
) -> Metrics:
    """Measure every variant and write the tables."""
    folders = {"ours": inputs.reconstruction, **inputs.variants}
    rng = np.random.default_rng(config.seed)
    lpips = Lpips.load(Path(config.lpips_weights), device) if config.lpips_weights else None
    metrics = table.metrics(folders, inputs, videos, config.heldout_frames, rng, device, lpips)
    metrics.write(out, "tables.json")
    (out / "tables.txt").write_text(table.text(metrics.values, tuple(folders)))
    shown = (table.pictures(metrics) | table.rooms(folders)).items()
    qa.write(
        out,
        good="ours is ahead of every baseline, for the animal and the room",
        bad="a baseline is as good as ours: what it leaves out does nothing",
        checks=table.checks(metrics.values, tuple(folders)),
        pictures=[qa.Picture(name, image, caption) for name, (image, caption) in shown],
    )
    return metrics
