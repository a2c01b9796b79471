"""The stage: trajectories and scenes -> a trained behavior model, as files."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from pipeline.behavior.diffusion import Schedule
from pipeline.behavior.scenes import Scenes
from pipeline.behavior.trajectories import TRAIN, BehaviorData, frames_from_seconds
from pipeline.core import devices, distributed, progress
from pipeline.core.errors import InputError
from pipeline.environments.other_home import ReconstructedHome
from stages.train_behavior import outcome
from stages.train_behavior.config import Config, Weighting
from stages.train_behavior.homes import with_other_homes
from stages.train_behavior.refusals import check_settings
from stages.train_behavior.training import train

SCHEDULES: dict[Weighting, Schedule] = {
    "noise": Schedule(method="ddpm"),
    "velocity": Schedule(),
    "flow": Schedule(course="rectified"),
}
"""Noise levels and sampler of goals by weighting; the paper samples by DDPM."""


@dataclass(frozen=True)
class Inputs:
    """What the stage reads."""

    behavior_data: Path
    """Trajectories, windows and scenes."""
    feature_basis: Path | None = None
    """Feature basis of its own build, if there are ``homes``; features of the others are converted to it."""
    scene_template: Path | None = None
    """Scale and floor of its own build, if there are ``homes``."""
    homes: Mapping[str, Path] | None = None
    """Folders of further builds of the same animal."""


def run(
    inputs: Inputs, config: Config, out: Path, *, device: devices.Device = "cpu", resume: Path | None = None
) -> None:
    """Train, export and evaluate the model; of several processes, the first one writes.

    Raises BEH-001, BEH-003, REC-002, ART-007, ART-010, SIM-011.
    """
    distributed.join(device)
    data = BehaviorData.load(inputs.behavior_data)
    data = data.with_horizon(frames_from_seconds(config.horizon_s, data.rate_hz))
    scenes = Scenes.load(inputs.behavior_data, data.videos)
    scenes = scenes.without_features() if config.scene == "none" else scenes
    architecture = outcome.architecture_for(config, data, scenes)
    schedule = SCHEDULES[config.training.objective.weighting]
    check_settings(config, data, architecture, str(inputs.behavior_data))
    homes = with_other_homes(data, scenes, *_homes(inputs, config))
    progress.log(
        f"{len(homes.data.indices(TRAIN))} training windows; {len(data.start)} windows of its own build"
    )
    fitted = train(
        homes, architecture, schedule, config.training, seed=config.seed, resume=resume, device=device
    )
    if not distributed.leave():
        return
    outcome.write_trained(out, fitted, architecture, schedule, data.agent_from_bone_rest)
    if config.export:
        outcome.write_exported(out, fitted, architecture, schedule, data, scenes, seed=config.seed)


def _homes(inputs: Inputs, config: Config) -> tuple[ReconstructedHome | None, list[Path]]:
    """Return the animal's own home and the folders of the others."""
    if not config.homes:
        return None, []
    if inputs.feature_basis is None or inputs.scene_template is None or inputs.homes is None:
        what = "homes are learned from reconstructions; here the flow begins at trajectories"
        remedy = "leave it out: put all tables into one folder"
        raise InputError("REC-002", what, "[train_behavior]: homes", remedy)
    own = ReconstructedHome.load(inputs.behavior_data, inputs.feature_basis, inputs.scene_template)
    return own, [inputs.homes[name] for name in config.homes]
