"""Losses of the baselines of Table 4, on the same batches and with the same condition dropout."""

import math
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from pipeline.baselines.samplers import LOG_STD_BOUNDS, LOG_STD_STEP, MEAN_STEP
from pipeline.behavior.diffusion import Schedule
from pipeline.behavior.model import BehaviorNets
from pipeline.core import distributed
from stages.train_behavior.batches import TrainingBatch
from stages.train_behavior.config import ObjectiveConfig
from stages.train_behavior.objective import (
    MOTION_WEIGHT,
    Denoise,
    TrainingPhase,
    goal_targets,
    joint_mask,
    level_losses,
    partly_foreseen,
    perceive,
    squared_error,
)


def gaussian_losses(
    nets: BehaviorNets,
    batch: TrainingBatch,
    schedule: Schedule,
    objective: ObjectiveConfig,
    generator: torch.Generator,
    *,
    phase: TrainingPhase = "all",
) -> dict[str, Float[Tensor, ""]]:
    """Return the negative log-likelihood per channel of goal, path and body, each given the level above.

    Goals are learned as ours are: by each member of the ensemble, and at earlier times, too.
    Paths are positions, as in the paper: a mean of strides, which are 0 at rest, is no mean of paths.
    """
    del schedule
    batch = replace(batch, path=torch.cat([batch.places, batch.path[:, 3:]], dim=1))

    def goal(code: Tensor) -> Tensor:
        clean, horizon = goal_targets(batch, objective, generator)
        each = negative_log_likelihood(lambda x, t: nets.goal.per_member(x, t, code, horizon), clean)
        return each.mean(0)

    each = negative_log_likelihood
    return level_losses(nets, batch, objective, generator, phase, goal, each, each)


def negative_log_likelihood(
    predict: Denoise, clean: Float[Tensor, "batch ..."]
) -> Float[Tensor, "batch ..."]:
    """Return -log N(clean; mean, std); ``predict`` returns mean and log std at two steps."""
    nothing = torch.zeros_like(clean)
    mean, log_std = (
        predict(nothing, torch.full((len(clean),), step, device=clean.device))
        for step in (MEAN_STEP, LOG_STD_STEP)
    )
    log_std = log_std.clamp(*LOG_STD_BOUNDS)
    return 0.5 * ((clean - mean) * torch.exp(-log_std)) ** 2 + log_std + 0.5 * math.log(2 * math.pi)


def one_stage_losses(
    nets: BehaviorNets,
    batch: TrainingBatch,
    schedule: Schedule,
    objective: ObjectiveConfig,
    generator: torch.Generator,
    *,
    phase: TrainingPhase = "all",
) -> dict[str, Float[Tensor, ""]]:
    """Return the denoising losses of path and body as one sequence without control."""
    assert phase == "all", "a model of one stage has no goals that could learn before"
    batch = partly_foreseen(nets, batch, 0.0, generator)
    code = perceive(nets, batch, objective, generator, joint_mask(batch, objective, generator))
    known = batch.bones_known
    seen = torch.where(known[:, None, None], batch.body, torch.zeros_like(batch.body))
    whole = torch.cat([batch.path, seen], dim=1)
    nothing = torch.zeros_like(batch.places), torch.zeros(len(code), 1, device=code.device)
    motion = torch.full((whole.shape[1], 1), MOTION_WEIGHT[objective.weighting], device=code.device)
    lead = batch.path.shape[1]
    motion[:lead] = 0
    weights = objective.weighting, generator, motion
    error = squared_error(lambda x, t: nets.body(x, t, code, *nothing), whole, schedule, *weights)
    body = error[:, lead:] * known[:, None, None]
    rows = distributed.mean(known.sum().float()).clamp_min(1 / distributed.size())
    return {"path": error[:, :lead].mean(), "body": body.sum() / (rows * body[0].numel())}
