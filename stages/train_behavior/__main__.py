"""Train the behaviour model: what the animal perceives, where it goes next, along which path, with which body.

Goal, path and body are three diffusion models under one perception code; conditions are dropped at random for
classifier-free guidance. Writes weights, ONNX networks and the contract that every sampler follows.
"""

from dataclasses import dataclass, field
from typing import Literal

from pipeline import cli, progress
from pipeline.models.diffusion import Schedule
from pipeline.models.scenes import Scenes
from pipeline.models.trajectories import TRAIN, BehaviorData, frames_from_seconds
from stages.train_behavior import outcome
from stages.train_behavior.outcome import architecture_for
from stages.train_behavior.refusals import refuse
from stages.train_behavior.training import Settings, train


@dataclass(frozen=True)
class Config:
    """Settings of the behaviour model and its training."""

    ego: Literal["yaw", "full", "world"] = "yaw"
    """Ego frame: the root's heading, its full rotation as in the paper, or, as an ablation, the world's axes and origin."""
    family: Literal["diffusion", "gaussian", "one_stage"] = "diffusion"
    """What is learned: goal, path and body by diffusion; each as a Gaussian; path and body at once without a goal."""
    control: Literal["unet", "concatenation"] = "unet"
    """How goal and path steer: by a twin UNet, or, as an ablation, as one more part of the perception code."""
    horizon_s: float = 5.6
    """Seconds that are predicted; an even number of 0.4 s. What the page shows is made for 5.6 s."""
    export: bool = True
    """Write what the simulator needs (ONNX, golden plan, pictures); off for the trials of the tables."""
    scene: Literal["pillars", "volume"] = "pillars"
    """Scene encoder: 2.5-D with height in channels, or the paper's six 3-D convolutions."""
    scene_width: int = 32
    """Channels of the scene encoder; the paper's is 128."""
    scene_block: Literal[1, 2, 4, 8] = 4
    """Cells of 0.1 m that pillars average along each axis before they convolve."""
    minds: int = 3
    """Perceptions and goal networks that learn apart and whose answers are averaged: fewer minutes of video by heart."""
    blind_to: Literal["nothing", "scene", "observer", "past"] = "nothing"
    """Ablation: a condition that the model never perceives."""
    observer_radius_m: float = 4.0
    """Horizontal distance in metres from which on an observer is as good as none."""
    unet_width: int = 16
    """Channels of the UNets' finest level."""
    unet_multipliers: tuple[int, ...] = (1, 2, 4)
    """Widths of the UNets' levels, in units of the finest."""
    reading: Literal["attention", "pointwise"] = "attention"
    """How goals look up the map of the 2.5-D encoder: attention, or, as in the released code, at the noisy point itself; then
    paths do so too, at each noisy waypoint."""
    schedule: Schedule = field(default_factory=Schedule)
    """Noise levels."""
    training: Settings = field(default_factory=Settings)
    """Length of training, augmentation, dropping of conditions."""
    seed: int = 0
    """Seed of weights, batches and noise."""


def run(task: cli.Task) -> None:
    """Train, export, judge."""
    c: Config = task.config
    data = BehaviorData.load(task.input("behavior_data")).with_horizon(frames_from_seconds(c.horizon_s))
    scenes = Scenes.load(task.input("behavior_data"), data.videos)
    architecture = architecture_for(vars(c), data, scenes)
    refuse(vars(c), data, architecture, str(task.input("behavior_data")))
    progress.log(f"{len(data.indices(TRAIN))} training windows, {len(data.start)} in all")
    fitted = train(data, scenes, architecture, c.schedule, c.training, seed=c.seed, resume=task.resume, device=task.device)
    with task.create() as folder:
        outcome.write_trained(folder, fitted, architecture, c.schedule, data.agent_from_bone_rest)
        if c.export:
            outcome.write_exported(folder, fitted, architecture, c.schedule, data, scenes, seed=c.seed)


if __name__ == "__main__":
    cli.enter(__doc__, run, config=Config, reads=("behavior_data",))
