"""What comes of a training: the model's own files and, where the simulator is to have it, its networks and its pictures."""

from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from pipeline import progress, qa
from pipeline.files import arrays
from pipeline.models.behavior import Architecture
from pipeline.models.diffusion import Schedule
from pipeline.models.planning import TorchNetworks
from pipeline.models.rivals import sampler_of
from pipeline.models.scenes import Scenes
from pipeline.models.trajectories import BehaviorData
from stages.train_behavior import export, pictures, reactions
from stages.train_behavior.training import Fitted


def architecture_for(settings: Mapping[str, Any], data: BehaviorData, scenes: Scenes) -> Architecture:
    """Return the networks' shape: what the configuration says of it, and what the data decides."""
    decided = {"bones": len(data.agent_from_bone_rest), "scene_channels": scenes.channels, "future": data.future}
    said = {field.name: settings[field.name] for field in fields(Architecture) if field.name in settings}
    return Architecture(**said | decided)


def write_trained(
    folder: Path, fitted: Fitted, architecture: Architecture, schedule: Schedule, rest: Float[np.ndarray, "bone 4 4"]
) -> None:
    """Write weights, contract and the losses of every step."""
    export.write_contract(folder, fitted.nets.cpu(), architecture, fitted.scaling, schedule, rest)
    arrays.save(folder / "losses.npz", **{f"loss/{name}": values for name, values in fitted.record.terms.items()})


def write_exported(
    folder: Path, fitted: Fitted, architecture: Architecture, schedule: Schedule, data: BehaviorData, scenes: Scenes, *, seed: int
) -> None:
    """Write the networks for other samplers, and how the model looks."""
    sampler = sampler_of(architecture, TorchNetworks(fitted.nets), schedule, fitted.scaling)
    difference = export.write_networks(folder, fitted.nets, architecture)
    moments = reactions.moments(data, scenes, architecture)
    reaction = reactions.measure(sampler, moments.observation, radius_m=architecture.observer_radius_m, seed=seed)
    progress.log(f"an approaching observer shifts goals {reaction.away_m:.2f} m away, a far one {reaction.far_m:.3f} m")
    qa.write(
        folder,
        good="goals that spread over where the animal could go and shift away from a close observer",
        bad="goals inside furniture, goals that ignore an approach, or an animal that shies at someone far away",
        checks=pictures.checks(fitted.record, reaction, difference),
        pictures=pictures.pictures(sampler, moments, scenes, fitted.record, seed=seed),
    )
