"""Train a template's localizer and write its files."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np

from pipeline.backends.descriptors import Describer
from pipeline.core import distributed
from pipeline.core.devices import Device
from pipeline.core.errors import InputError
from pipeline.data import ply, qa
from pipeline.data.clips import Clip
from pipeline.data.templates import SceneCameras, SkinTable, read_floor
from pipeline.localization import localizer as localizers
from stages.train_localizer import pictures, training
from stages.train_localizer.config import Config

InputT = TypeVar("InputT")


@dataclass(frozen=True)
class Inputs:
    """Folders of finished artifacts; which template is needed depends on the target."""

    feature_basis: Path | None = None
    """Names the descriptor of all features; None: DAISY."""
    scene_template: Path | None = None
    """Target scene."""
    frames: Mapping[str, Path] | None = None
    """Target scene: the walk-through of its template, by recording."""
    agent_template: Path | None = None
    """Target agent."""


def run(inputs: Inputs, config: Config, out: Path, *, device: Device = "cpu") -> localizers.Localizer | None:
    """Train, evaluate and write the localizer; None in all processes but the first.

    A bank is not trained: the first process builds it alone. Raises InputError MAP-006 where the map
    fills hardly any view.
    """
    distributed.join(device)
    if config.kind == "bank" and not distributed.leave():
        return None
    rng = np.random.default_rng(config.seed)
    describer = Describer() if inputs.feature_basis is None else Describer.load(inputs.feature_basis)
    match config.target:
        case "scene":
            views = _scene_views(inputs, config, rng)
        case "agent":
            template = _required(inputs.agent_template, "agent_template")
            skin = SkinTable.open(template) if config.agent.posture_deg else None
            views = training.agent_views(ply.read_ply(template / "agent.ply"), config.agent, rng, skin)
    localizer, held_out = training.train(views, config, describer, device, rng)
    if not distributed.leave():
        return None
    localizers.save(out, localizer, pictures.report(held_out, config.target))
    qa.write(
        out,
        good="held-out renders are localized within a degree or two, wrong poses get low probabilities",
        bad="the histogram has its weight on the right, or confident poses are wrong",
        checks=pictures.checks(held_out, config.target),
        pictures=pictures.pictures(held_out, localizer, config.target),
    )  # fmt: skip
    return localizer


def _scene_views(inputs: Inputs, config: Config, rng: np.random.Generator) -> training.TrainingViews:
    template = _required(inputs.scene_template, "scene_template")
    clip = Clip.open(next(iter(_required(inputs.frames, "frames").values())))
    walk = SceneCameras.open(template).world_from_registered
    floor_m = read_floor(template)
    return training.scene_views(ply.read_ply(template / "mesh.ply"), walk, floor_m, clip, config.scene, rng)


def _required(value: InputT | None, name: str) -> InputT:
    """Return a required input. Raises InputError ART-001 if it is None."""
    if value is None:
        raise InputError(
            "ART-001", "is missing, but the target requires it", name, f"pass --{name.replace('_', '-')}"
        )
    return value
