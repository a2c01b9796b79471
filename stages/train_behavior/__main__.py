"""Train the behaviour model: what the animal perceives, where it goes next, along which path, with which body.

Goal, path and body are three diffusion models under one perception code; conditions are dropped at random for
classifier-free guidance. Writes weights, ONNX networks and the contract that every sampler follows.
"""

from dataclasses import dataclass, field
from typing import Literal

from pipeline import cli, progress
from pipeline.errors import InputError
from pipeline.models.diffusion import Schedule
from pipeline.models.scenes import Scenes
from pipeline.models.trajectories import PAST, RATE_HZ, TRAIN, BehaviorData, frames_from_seconds
from stages.train_behavior import outcome
from stages.train_behavior.outcome import architecture_for
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
    refuse(c, data, bool(architecture.map_cells), str(task.input("behavior_data")))
    progress.log(f"{len(data.indices(TRAIN))} training windows, {len(data.start)} in all")
    fitted = train(data, scenes, architecture, c.schedule, c.training, seed=c.seed, resume=task.resume, device=task.device)
    with task.create() as folder:
        outcome.write_trained(folder, fitted, architecture, c.schedule, data.agent_from_bone_rest)
        if c.export:
            outcome.write_exported(folder, fitted, architecture, c.schedule, data, scenes, seed=c.seed)


def refuse(c: Config, data: BehaviorData, mapped: bool, where: str) -> None:
    """Raise REC-002 for settings of which nothing can be learned or made, BEH-001 where no window is as long as they want."""
    pace = c.training.optimization
    if c.reading == "pointwise" and not mapped:
        raise InputError("REC-002", "the 3-D encoder makes no map", "[train_behavior]: reading", 'scene = "pillars" makes one')
    if c.family == "one_stage" and c.export:
        what = "a model without goals cannot be exported: page and samplers ask for them"
        raise InputError("REC-002", what, "[train_behavior]: export", "set it to false; `make behavior-tables` judges such models")
    if c.family != "one_stage" and pace.steps <= pace.goal_steps:
        what = f"{pace.goal_steps} steps of goals leave none of {pace.steps} to paths and bodies"
        raise InputError("REC-002", what, "[train_behavior.training.optimization]: steps", "take more steps, or fewer `goal_steps`")
    if not len(data.indices(TRAIN)):
        what = f"no {(PAST + data.future) / RATE_HZ:.1f} s of uninterrupted motion to learn from"
        raise InputError("BEH-001", what, where, "film longer sessions in which the animal stays in view, or foretell less (`horizon_s`)")


if __name__ == "__main__":
    cli.enter(__doc__, run, config=Config, reads=("behavior_data",))
