"""Outputs of training: the model's files and, for the simulator, ONNX networks and pictures."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from pipeline.baselines.samplers import sampler_of
from pipeline.behavior.config import SceneEncoder
from pipeline.behavior.diffusion import Schedule
from pipeline.behavior.model import Architecture
from pipeline.behavior.planning import TorchNetworks
from pipeline.behavior.scenes import Scenes
from pipeline.behavior.trajectories import BehaviorData
from pipeline.core import progress
from pipeline.data import npz, qa
from stages.train_behavior import export, pictures, reactions
from stages.train_behavior.config import Config
from stages.train_behavior.training import TrainedBehavior

SCENE_CHANNELS: dict[SceneEncoder, int] = {"pillars": 32, "volume": 128, "none": 0}
"""Width of the scene encoder: 32 suffices for minutes of video, 128 is the paper's (appendix A.2)."""
COMPANIONS_RADIUS_M = 8.0
"""Radius of perception with companions, about a room: in unseen homes the energy score of goals beside a cat
is 0.79 m, with 4 m 0.83 m. An animal that knows only the person learns less from 8 m than from 4 m."""
BODY_COMPONENTS = 24
"""Principal components of bones that the UNet of bodies corrects: 93 % of the variance of a cat's bones."""


def preconditioned(config: Config) -> bool:
    """Return whether bodies have a Gaussian prior: not if they are regressed or not trained, nor with the
    paper's loss or encoding.
    """
    objective = config.training.objective
    if config.encoding == "positions":
        return False
    trained = config.family == "one_stage" or objective.body_share > 0
    return trained and config.family != "gaussian" and objective.weighting != "noise"


def architecture_for(config: Config, data: BehaviorData, scenes: Scenes) -> Architecture:
    """Return the architecture given configuration and data."""
    return Architecture(
        bones=len(data.agent_from_bone_rest),
        ego=config.ego,
        scene=config.scene,
        observed_past=config.observed_past,
        scene_width=SCENE_CHANNELS[config.scene],
        scene_channels=scenes.channels,
        observer_radius_m=max(config.observer_radius_m, COMPANIONS_RADIUS_M * data.accompanied),
        companions=data.accompanied,
        ablated_input=config.ablated_input,
        body_components=BODY_COMPONENTS if preconditioned(config) else 0,
        unet_width=config.unet_width,
        family=config.family,
        control=config.control,
        past=data.past,
        future=data.future,
        rate_hz=data.rate_hz,
        ensemble_size=config.ensemble_size,
        guided="all" if config.training.objective.joint_dropout else "observer",
        encoding=config.encoding,
        corrections=config.corrections,
    )


def write_trained(
    folder: Path,
    fitted: TrainedBehavior,
    architecture: Architecture,
    schedule: Schedule,
    rest: Float[np.ndarray, "bone 4 4"],
) -> None:
    """Write weights, contract and the losses of every step."""
    export.write_contract(folder, fitted.nets.cpu(), architecture, fitted.scaling, schedule, rest)
    losses = {f"loss/{name}": values for name, values in fitted.record.terms.items()}
    npz.save(folder / "losses.npz", compress=False, **losses)


def write_exported(
    folder: Path,
    fitted: TrainedBehavior,
    architecture: Architecture,
    schedule: Schedule,
    data: BehaviorData,
    scenes: Scenes,
    *,
    seed: int,
) -> None:
    """Write the ONNX networks, checks and pictures."""
    sampler = sampler_of(architecture, TorchNetworks(fitted.nets), schedule, fitted.scaling)
    difference = export.write_networks(folder, fitted.nets, architecture)
    moments = reactions.moments(data, scenes, architecture)
    radius_m = architecture.observer_radius_m
    reaction = reactions.measure(sampler, moments.observation, radius_m=radius_m, seed=seed)
    shifts = f"{reaction.away_m:.2f} m away, a far one {reaction.far_m:.3f} m"
    progress.log(f"an approaching observer shifts goals {shifts}")
    qa.write(
        folder,
        good="goals that spread over where the animal could go and shift away from a close observer",
        bad="goals inside furniture, goals that ignore an approach, or an animal that shies at a far person",
        checks=pictures.checks(fitted.record, reaction, difference),
        pictures=pictures.pictures(sampler, moments, scenes, fitted.record, seed=seed),
    )
