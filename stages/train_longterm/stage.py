"""Train long-term motion from recorded or simulated motion."""

from dataclasses import dataclass
from pathlib import Path

from pipeline.core import distributed, progress
from pipeline.core.errors import InputError
from pipeline.data import qa
from pipeline.longterm import simulated_lives
from pipeline.longterm.examples import DatasetSplit
from pipeline.longterm.short_motions import RATE_HZ
from stages.train_longterm import learning, pictures, sources
from stages.train_longterm.config import Config
from stages.train_longterm.learning import TrainedLongTerm


@dataclass(frozen=True)
class Inputs:
    """Training artifacts: simulated motion, or a reconstruction with its behavior data."""

    reconstruction: Path | None = None
    behavior_data: Path | None = None
    longterm_world: Path | None = None


def run(inputs: Inputs, config: Config, out: Path, *, resume: Path | None = None) -> TrainedLongTerm:
    """Train all networks; the first process writes `longterm.safetensors`, `longterm.json`, `ablations/`.

    Raises InputError REC-002 for SMPL-X without motions, or the reverse, and LTM-001 to LTM-005 for missing
    or damaged motion, weights or SMPL-X.
    """
    distributed.join("cpu")
    split = _read(inputs, config)
    minutes = sum(map(len, split.train.stretches)) / (60 * RATE_HZ)
    progress.log(f"{len(split.train.stretches)} stretches of motion, {minutes:.1f} min at {RATE_HZ} fps")
    trained = learning.train_networks(split.train, config, resume=resume)
    if not distributed.leave():
        return trained
    checks, shown = pictures.evaluate_held_out(trained, split, config.seed)
    trained.model.save(out)
    learning.write_ablations(out, trained)
    qa.write(
        out,
        good="routes that turn where the animal's do, bodies that stand on what is beneath them",
        bad="routes through furniture, bodies in the air or in the ground",
        checks=checks,
        pictures=shown,
    )
    return trained


def _read(inputs: Inputs, config: Config) -> DatasetSplit:
    if (config.smplx_model is None) != (config.smplx_motions is None):
        what, remedy = "one of smplx_model and smplx_motions is missing", "give both to learn people, or none"
        raise InputError("REC-002", what, "[longterm]", remedy)
    if config.smplx_model is not None and config.smplx_motions is not None:
        return sources.people(Path(config.smplx_model), Path(config.smplx_motions))
    if inputs.longterm_world is not None:
        return simulated_lives.load(inputs.longterm_world)
    assert inputs.reconstruction is not None and inputs.behavior_data is not None, "nothing to learn from"
    return sources.recorded(inputs.reconstruction, inputs.behavior_data)
