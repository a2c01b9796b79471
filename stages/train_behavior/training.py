"""Training of perception and the three denoisers together, with an average of the weights kept beside."""

import copy
import math
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import torch

from pipeline.fit import FitRecord, fit
from pipeline.models.behavior import ROOT_CHANNELS, Architecture, BehaviorNets, Scaling
from pipeline.models.diffusion import Schedule
from pipeline.models.pointwise import WaypointUNet
from pipeline.models.scenes import Scenes
from pipeline.models.trajectories import TRAIN, BehaviorData
from stages.train_behavior.batches import (
    Augmentation,
    SceneSampler,
    Statistics,
    draw_batch,
    statistics_from_windows,
    windows_from_data,
)
from stages.train_behavior.objective import Objective, Part, losses
from stages.train_behavior.rival_losses import gaussian_losses, one_stage_losses

_STEPS = 2.0**12


@dataclass(frozen=True)
class Optimization:
    """How long and how fast."""

    steps: int = 1000
    goal_steps: int = 200
    """first steps, in which perception and goals are trained alone; then both rest, for they learn minutes of video by heart
    long before path and body are good. 0 = all are trained together throughout, as models of one stage always are"""
    batch: int = 64
    """windows per step"""
    goal_batch: int = 64
    """windows per step while perception and goals are trained alone"""
    rate: float = 2e-3
    """peak learning rate of AdamW"""
    weight_decay: float = 0.05
    average: float = 0.995
    """decay per step of the averaged weights"""
    save_every: int = 200
    """steps between checkpoints"""
    precision: Literal["float32", "bfloat16"] = "float32"
    """of the convolutions of path and body, which cost the most: half as many bits are faster on most GPUs"""
    compile: bool = False
    """compile path and body, which takes a minute and a C++ compiler; on a GPU they run as one CUDA graph each"""


@dataclass(frozen=True)
class Settings:
    """Everything that a recipe may say about training."""

    optimization: Optimization = field(default_factory=Optimization)
    """length and speed"""
    augmentation: Augmentation = field(default_factory=Augmentation)
    """how far samples stray from the recorded ones"""
    objective: Objective = field(default_factory=Objective)
    """dropping of conditions and the number of noise levels"""
    per_frame: bool = False
    """scale strides in each frame of the horizon on its own, as the released code does, not in all alike"""


@dataclass(frozen=True)
class Fitted:
    """A trained model."""

    nets: BehaviorNets
    """the average of the weights"""
    scaling: Scaling
    record: FitRecord


def train(
    data: BehaviorData,
    scenes: Scenes,
    architecture: Architecture,
    schedule: Schedule,
    settings: Settings,
    *,
    seed: int,
    resume: Path | None = None,
    device: str = "cpu",
) -> Fitted:
    """Fit the networks to the training windows of the data."""
    minimised = {"diffusion": losses, "gaussian": gaussian_losses, "one_stage": one_stage_losses}[architecture.family]
    windows = windows_from_data(data, data.indices(TRAIN), architecture, scenes)
    statistics = statistics_from_windows(windows, settings.augmentation.largest_turn_rad, per_frame=settings.per_frame)
    nets = initial_nets(architecture, schedule, statistics, seed).to(device)
    average = copy.deepcopy(nets).requires_grad_(False)
    scene = SceneSampler(scenes, architecture.scene_stride, device)
    pace, drawn = settings.optimization, settings.augmentation
    of_paths = replace(drawn, approached=drawn.approached_paths)
    goal_steps = 0 if architecture.family == "one_stage" else pace.goal_steps
    quicken(nets, pace, device)
    optimizer = torch.optim.AdamW(nets.parameters(), lr=pace.rate, weight_decay=pace.weight_decay, fused=True)

    def loss(step: int, generator: torch.Generator) -> dict[str, torch.Tensor]:
        if pace.compile:
            torch.compiler.cudagraph_mark_step_begin()
        part: Part = "all" if goal_steps == 0 else "goals" if step < goal_steps else "sequences"
        size = pace.goal_batch if part == "goals" else pace.batch
        how = of_paths if part == "sequences" else drawn
        batch = draw_batch(windows, scene, statistics, how, size, generator, bodies=part != "goals")
        return minimised(nets, batch, schedule, settings.objective, generator, part=part)

    def after_step(step: int) -> None:
        begun = step - goal_steps if step >= goal_steps else step
        decay = min(pace.average, (begun + 1) / (begun + 10))
        with torch.no_grad():
            for mean, parameter in zip(average.parameters(), nets.parameters(), strict=True):
                mean.lerp_(parameter, 1 - decay)
        if step + 1 == goal_steps:
            nets.perception.load_state_dict(average.perception.state_dict())
            nets.goal.load_state_dict(average.goal.state_dict())

    record = fit(
        modules={"nets": nets, "average": average},
        optimizer=optimizer,
        loss=loss,
        steps=pace.steps,
        seed=seed,
        resume=resume,
        save_every=pace.save_every,
        schedule=lambda progress: two_cosines(progress, goal_steps / pace.steps),
        label="behaviour",
        clip_norm=1.0,
        after_step=after_step,
    )
    return Fitted(rounded(average.eval()), statistics.scaling, record)


def quicken(nets: BehaviorNets, pace: Optimization, device: str) -> None:
    """Let path and body compute in the precision that is asked for, compiled if that is; weights stay in float32."""
    kind = torch.device(device).type
    for net in (nets.path, nets.body):
        if pace.precision == "bfloat16":
            net.forward = torch.autocast(kind, torch.bfloat16)(net.forward)
        if pace.compile:
            net.compile(mode="reduce-overhead" if kind == "cuda" else "default")


def rounded(nets: BehaviorNets) -> BehaviorNets:
    """Round weights to 12 significant bits: nearly half of what a page sends of them, and far finer than training can tell."""
    with torch.no_grad():
        for weight in nets.parameters():
            mantissa, exponent = torch.frexp(weight)
            weight.copy_(torch.ldexp((mantissa * _STEPS).round() / _STEPS, exponent))
    return nets


def initial_nets(architecture: Architecture, schedule: Schedule, statistics: Statistics, seed: int) -> BehaviorNets:
    """Return freshly initialised networks that know the statistics of the past."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        nets = BehaviorNets(architecture, schedule)
    for mind in nets.perception:
        mind.past.mean[:], mind.past.std[:] = statistics.past_mean, statistics.past_std
    scaling, body = statistics.scaling, nets.body
    told = (scaling.path_std, scaling.body_mean[:ROOT_CHANNELS], scaling.body_std[:ROOT_CHANNELS])
    for buffer, numbers in zip((body.path_std, body.root_mean, body.root_std), told, strict=True):
        buffer[:] = torch.from_numpy(numbers)
    if nets.goal.map is not None:
        nets.goal.map.goal_std[:] = torch.from_numpy(scaling.goal_std)
    if isinstance(nets.path, WaypointUNet):
        nets.path.stride_std[:] = torch.from_numpy(scaling.stride_std)
    return nets


def two_cosines(progress: float, turn: float) -> float:
    """Return the factor on the learning rate: one `warm_cosine` up to ``turn``, another after it."""
    if turn >= 1:
        return warm_cosine(progress)
    return warm_cosine(progress / turn if progress < turn else (progress - turn) / (1 - turn))


def warm_cosine(progress: float) -> float:
    """Return the factor on the learning rate: a rise over 2 %, then half a cosine down to 2 %."""
    return min(1.0, (progress + 1e-3) / 0.02) * (0.51 + 0.49 * math.cos(math.pi * progress))
