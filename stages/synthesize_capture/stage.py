"""The stage: a seed -> Record3D recordings and, apart from them, the truth."""

from dataclasses import dataclass
from pathlib import Path
from typing import assert_never

import numpy as np

from pipeline.core import progress
from pipeline.core.errors import InputError
from stages.synthesize_capture import animal, produce, review, room, script
from stages.synthesize_capture.config import Config


@dataclass(frozen=True)
class Inputs:
    """The stage reads nothing."""


def run(inputs: Inputs, config: Config, out: Path, *, threads: int = 1) -> None:
    """Build the world, write every recording's script, film them, and keep the truth apart."""
    if config.companion == config.species:
        raise InputError(
            "REC-002",
            f"both animals are of species {config.species!r}",
            "[synthesize_capture]",
            "give `companion` or `species` another value",
        )
    home = room.furnish(np.random.default_rng([config.seed, 0]))
    creature = animal.grow(np.random.default_rng([config.seed, 2]), species=config.species)
    scripts = script.scripts(config, home)
    progress.log(f"world: {len(scripts)} recordings, {sum(len(part.timestamp_s) for part in scripts)} frames")
    recordings, truth = out / "recordings", out / "truth"
    recordings.mkdir()
    truth.mkdir()
    match config.companion:
        case "none":
            second, worlds = None, {truth: creature}
        case "dog":
            second = animal.grow(np.random.default_rng([config.seed, 3]), species="dog")
            worlds = {truth / each.anatomy.name: each for each in (creature, second)}
        case _:
            assert_never(config.companion)
    made = produce.produce(scripts, creature, recordings, truth, workers=threads, companion=second)
    for folder, each in worlds.items():
        produce.write_world(home, each, config.seed, folder)
    review.report_quality(out, scripts, made)
