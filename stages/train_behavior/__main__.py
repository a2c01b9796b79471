"""Train the behaviour model: what the animal perceives, where it goes next, along which path, with which body.

Goal, path and body are three diffusion models under one perception code; conditions are dropped at random for
classifier-free guidance. Writes weights, ONNX networks and the contract that every sampler follows.
"""

from dataclasses import dataclass, field
from typing import Literal

from pipeline import cli, progress, qa
from pipeline.models.behavior import Architecture
from pipeline.models.diffusion import Schedule
from pipeline.models.planning import Sampler, TorchNetworks
from pipeline.models.scenes import Scenes
from pipeline.models.trajectories import TRAIN, BehaviorData
from stages.train_behavior import export, pictures, reactions
from stages.train_behavior.training import Settings, train


@dataclass(frozen=True)
class Config:
    """Settings of the behaviour model and its training."""

    ego: Literal["yaw", "full"] = "yaw"
    """Ego frame: only the heading of the root, or its full rotation as in the paper."""
    scene: Literal["pillars", "volume"] = "pillars"
    """Scene encoder: 2.5-D with height in channels, or the paper's six 3-D convolutions."""
    scene_width: int = 32
    """Channels of the scene encoder; the paper's is 128."""
    blind_to: Literal["nothing", "scene", "observer", "past"] = "nothing"
    """Ablation: a condition that the model never perceives."""
    goal_from: Literal["scene_observer", "all"] = "all"
    """What goals depend on; the paper's `all` includes the past."""
    observer_radius_m: float = 4.0
    """Horizontal distance in metres from which on an observer is as good as none."""
    unet_width: int = 32
    """Channels of the UNets' finest level."""
    unet_multipliers: tuple[int, ...] = (1, 2, 4)
    """Widths of the UNets' levels, in units of the finest."""
    training: Settings = field(default_factory=Settings)
    """Length of training, augmentation, dropping of conditions."""
    seed: int = 0
    """Seed of weights, batches and noise."""


def run(task: cli.Task) -> None:
    """Train, export, judge."""
    c: Config = task.config
    data = BehaviorData.load(task.input("behavior_data"))
    scenes = Scenes.load(task.input("behavior_data"), data.videos)
    architecture = Architecture(
        bones=len(data.agent_from_bone_rest), ego=c.ego, scene=c.scene, scene_width=c.scene_width,
        scene_channels=scenes.channels, observer_radius_m=c.observer_radius_m, blind_to=c.blind_to, goal_from=c.goal_from, unet_width=c.unet_width,
        unet_multipliers=c.unet_multipliers,
    )  # fmt: skip
    progress.log(f"{len(data.indices(TRAIN))} training windows, {len(data.start)} in all")
    fitted = train(data, scenes, architecture, Schedule(), c.training, seed=c.seed, resume=task.resume, device=task.device)
    sampler = Sampler(TorchNetworks(fitted.nets.cpu()), Schedule(), fitted.scaling)
    moments = reactions.moments(data, scenes, architecture)
    reaction = reactions.measure(sampler, moments.observation, radius_m=c.observer_radius_m, seed=c.seed)
    progress.log(f"an approaching observer shifts goals {reaction.away_m:.2f} m away, a far one {reaction.far_m:.3f} m")
    with task.create() as folder:
        rest = data.agent_from_bone_rest
        difference = export.write_model(folder, fitted.nets, architecture, fitted.scaling, Schedule(), rest)
        qa.write(
            folder,
            good="goals that spread over where the animal could go and shift away from a close observer",
            bad="goals inside furniture, goals that ignore an approach, or an animal that shies at someone far away",
            checks=pictures.checks(fitted.record, reaction, difference),
            pictures=pictures.pictures(sampler, moments, scenes, fitted.record, seed=c.seed),
        )


if __name__ == "__main__":
    cli.enter(__doc__, run, config=Config, reads=("behavior_data",))
