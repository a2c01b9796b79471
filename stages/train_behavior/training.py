"""Training of perception and the three denoisers, with an exponential moving average of the weights."""

import copy
import math
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from pipeline.behavior.body_denoiser import BodyDenoiser, OneStageDenoiser
from pipeline.behavior.diffusion import Schedule
from pipeline.behavior.model import ROOT_CHANNELS, Architecture, BehaviorNets, Scaling
from pipeline.behavior.perception import POSITION, VolumeScene
from pipeline.core import distributed
from pipeline.core.training import FitRecord, fit
from pipeline.environments.homes import Habitat
from stages.train_behavior import batches
from stages.train_behavior.baseline_losses import gaussian_losses, one_stage_losses
from stages.train_behavior.batches import TrainingWindows, WindowStatistics, draw_batch
from stages.train_behavior.config import AugmentationConfig, BehaviorOptimizerConfig, BehaviorTrainingConfig
from stages.train_behavior.objective import TrainingPhase, losses
from stages.train_behavior.scene_sampler import SceneSampler

WEIGHT_DECAY = 0.05
"""Weight decay of AdamW; the usual 0.01 overfits minutes of video."""
CHECKPOINTS = 20
"""Number of checkpoints of a training; a killed run repeats at most a twentieth."""
CLIP_NORM = 1.0
"""Gradient norm that is clipped to; single windows with jumps exceed it."""
AVERAGE_WARMUP_STEPS = 10
"""Warm-up of the moving average, so that it forgets the initial weights."""
MANTISSA_STEPS = 2.0**12
"""Quantization of mantissas of weights: 12 significant bits."""
PRIOR_WINDOWS, PRIOR_BATCH = 512, 64
"""Windows that the Gaussian prior of bodies is fitted to, and how many are drawn at once to bound memory."""
WARMUP_SHARE, FINAL_RATE_SHARE = 0.02, 0.02
"""Share of a phase with rising learning rate, and final learning rate relative to its peak."""


@dataclass(frozen=True)
class TrainedBehavior:
    """A trained model."""

    nets: BehaviorNets
    """networks with averaged weights"""
    scaling: Scaling
    record: FitRecord


def train(
    homes: Habitat,
    architecture: Architecture,
    schedule: Schedule,
    settings: BehaviorTrainingConfig,
    *,
    seed: int,
    resume: Path | None = None,
    device: str = "cpu",
) -> TrainedBehavior:
    """Fit the networks to the training windows; bodies to those of the animal's own build.

    Several processes (`pipeline.core.distributed`) share each step's batch; all hold the same networks.
    """
    losses_of = {"diffusion": losses, "gaussian": gaussian_losses, "one_stage": one_stage_losses}
    family_losses = losses_of[architecture.family]
    windows = batches.windows_from_data(homes, architecture)
    statistics = batches.statistics_from_windows(windows, batches.largest_turn_rad(settings.augmentation))
    nets = initial_nets(architecture, schedule, statistics, seed).to(device)
    scene = SceneSampler(homes.scenes, architecture.scene_stride, device)
    optimization, augmentation = settings.optimization, settings.augmentation
    of_paths = replace(augmentation, approached=augmentation.approached_paths)
    goal_steps = 0 if architecture.family == "one_stage" else optimization.goal_steps
    if architecture.body_components and windows.bones_known.any():
        of_bodies = of_paths if goal_steps else augmentation
        fit_body_prior(nets, windows, scene, statistics, of_bodies, seed)
    average = copy.deepcopy(nets).requires_grad_(False)
    accelerate(nets, optimization, device)
    optimizer = torch.optim.AdamW(
        nets.parameters(), lr=optimization.rate, weight_decay=WEIGHT_DECAY, fused=True
    )

    def loss(step: int, generator: torch.Generator) -> dict[str, torch.Tensor]:
        if optimization.compile:
            torch.compiler.cudagraph_mark_step_begin()
        phase: TrainingPhase = "all" if goal_steps == 0 else "goals" if step < goal_steps else "sequences"
        size = optimization.goal_batch if phase == "goals" else optimization.batch
        augmented = of_paths if phase == "sequences" else augmentation
        size = distributed.share(size)
        batch = draw_batch(windows, scene, statistics, augmented, size, generator, bodies=phase != "goals")
        return family_losses(nets, batch, schedule, settings.objective, generator, phase=phase)

    record = fit(
        modules={"nets": nets, "average": average},
        optimizer=optimizer,
        loss=loss,
        steps=optimization.steps,
        seed=seed,
        resume=resume,
        save_every=max(optimization.steps // CHECKPOINTS, 1),
        schedule=lambda progress: two_cosines(progress, goal_steps / optimization.steps),
        label="behavior",
        clip_norm=CLIP_NORM,
        after_step=lambda step: _average(average, nets, step, goal_steps, optimization.average),
        shared=True,
    )
    return TrainedBehavior(rounded(average.eval()), statistics.scaling, record)


def _average(average: BehaviorNets, nets: BehaviorNets, step: int, goal_steps: int, max_decay: float) -> None:
    """Update the moving average; after the goal phase, load it into perception and goal networks."""
    begun = step - goal_steps if step >= goal_steps else step
    decay = min(max_decay, (begun + 1) / (begun + AVERAGE_WARMUP_STEPS))
    with torch.no_grad():
        for mean, parameter in zip(average.parameters(), nets.parameters(), strict=True):
            mean.lerp_(parameter, 1 - decay)
    if step + 1 == goal_steps:
        nets.perception.load_state_dict(average.perception.state_dict())
        nets.goal.load_state_dict(average.goal.state_dict())


def accelerate(nets: BehaviorNets, optimization: BehaviorOptimizerConfig, device: str) -> None:
    """Set precision of path, body and 3-D scenes, and compilation, as configured; weights stay float32."""
    kind = torch.device(device).type
    for scene in (member.scene for member in nets.perception):
        if optimization.precision == "bfloat16" and isinstance(scene, VolumeScene):
            scene.code = torch.autocast(kind, torch.bfloat16)(scene.code)
    of_body = nets.body.unet if isinstance(nets.body, BodyDenoiser) else nets.body
    for net, unet in ((nets.path, nets.path), (nets.body, of_body)):
        if optimization.precision == "bfloat16":
            unet.velocity = torch.autocast(kind, torch.bfloat16)(unet.velocity)
        if optimization.compile:
            net.compile(mode="reduce-overhead" if kind == "cuda" else "default")


def rounded(nets: BehaviorNets) -> BehaviorNets:
    """Round weights to 12 significant bits, which halves their compressed size for the page."""
    with torch.no_grad():
        for weight in nets.parameters():
            mantissa, exponent = torch.frexp(weight)
            weight.copy_(torch.ldexp((mantissa * MANTISSA_STEPS).round() / MANTISSA_STEPS, exponent))
    return nets


def initial_nets(
    architecture: Architecture, schedule: Schedule, statistics: WindowStatistics, seed: int
) -> BehaviorNets:
    """Return initialized networks with the statistics of the data in their buffers."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        nets = BehaviorNets(architecture, schedule)
    for member in nets.perception:
        member.past.mean[:], member.past.std[:] = statistics.past_mean, statistics.past_std
    scaling, body = statistics.scaling, nets.body
    if isinstance(body, BodyDenoiser):
        body.path_std[:] = torch.from_numpy(scaling.path_std)
        body.root_mean[:] = torch.from_numpy(scaling.body_mean[:ROOT_CHANNELS])
        body.root_std[:] = statistics.past_std[POSITION : POSITION + ROOT_CHANNELS]
        body.rotation_std[:] = torch.from_numpy(scaling.body_std[:ROOT_CHANNELS])
    for part in (nets.goal.map, nets.goal.others):
        if part is not None:
            part.goal_std[:] = torch.from_numpy(scaling.goal_std)
    if isinstance(body, OneStageDenoiser):
        body.velocity_std[:] = torch.from_numpy(scaling.velocity_std)
    return nets


def fit_body_prior(
    nets: BehaviorNets,
    windows: TrainingWindows,
    scene: SceneSampler,
    statistics: WindowStatistics,
    augmentation: AugmentationConfig,
    seed: int,
) -> None:
    """Fit the Gaussian prior of bodies to windows augmented as in training, but not mirrored, which hides
    bones. All processes fit the same.
    """
    generator, rows, count = torch.Generator().manual_seed(seed), [], 0
    augmentation, denoiser = replace(augmentation, mirror=0.0), nets.body
    assert isinstance(denoiser, BodyDenoiser), "only bodies relative to the posture have a prior"
    while count < PRIOR_WINDOWS:
        batch = draw_batch(windows, scene, statistics, augmentation, PRIOR_BATCH, generator)
        body, along = batch.body[batch.bones_known], batch.places[batch.bones_known]
        now = torch.zeros_like(along[:, 0, 0])
        held = nets.perception.now(batch.held[batch.bones_known], now + 1)
        lead = batch.path[batch.bones_known] if isinstance(denoiser, OneStageDenoiser) else body[:, :0]
        clean = torch.cat([lead, body], dim=1)
        rows.append((denoiser.posture(clean, now, held, along)[0], clean))
        count += len(clean)
    posture, clean = (torch.cat(part) for part in zip(*rows, strict=True))
    denoiser.prior.fit(posture, clean)


def two_cosines(progress: float, turn: float) -> float:
    """Return the factor on the learning rate: one `warm_cosine` up to ``turn``, another after it."""
    if turn >= 1:
        return warm_cosine(progress)
    return warm_cosine(progress / turn if progress < turn else (progress - turn) / (1 - turn))


def warm_cosine(progress: float) -> float:
    """Return the factor on the learning rate: a rise over 2 %, then half a cosine down to 2 %."""
    return min(1.0, (progress + 1e-3) / WARMUP_SHARE) * (
        (1 + FINAL_RATE_SHARE) / 2 + (1 - FINAL_RATE_SHARE) / 2 * math.cos(math.pi * progress)
    )
