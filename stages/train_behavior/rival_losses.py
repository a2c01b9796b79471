"""What the rival models of Table 4 minimise, on the same batches and with the same dropping of conditions."""

import contextlib
import math

import torch
from jaxtyping import Float
from torch import Tensor

from pipeline.behavior.diffusion import Schedule
from pipeline.behavior.model import BehaviorNets
from pipeline.behavior.path_encoding import PATH_CHANNELS
from pipeline.rivals.samplers import LOG_STD_BOUNDS, LOG_STD_STEP, MEAN_STEP
from stages.train_behavior.batches import TrainingBatch
from stages.train_behavior.config import ObjectiveConfig
from stages.train_behavior.objective import (
    Denoise,
    TrainingPhase,
    keep_mask,
    mean_of_known,
    perceive,
    sequence_rows,
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
    """Return the negative log-likelihood per number of goal, path and body, each given the level above it."""
    del schedule
    with torch.no_grad() if phase == "sequences" else contextlib.nullcontext():
        code = perceive(nets, batch, objective, generator)
        goal = negative_log_likelihood(lambda x, t: nets.goal(x, t, code), batch.goal).mean()
    goal_loss = {} if phase == "sequences" else {"goal": goal}
    if phase == "goals":
        return goal_loss
    path_rows, body_rows, known = sequence_rows(batch, objective)
    steered = keep_mask(len(code), 1, generator).to(code.device)
    towards, along = batch.goal[path_rows], batch.places[body_rows]
    path = negative_log_likelihood(
        lambda x, t: nets.path(x, t, code[path_rows], towards, steered[path_rows]), batch.path[path_rows]
    )
    body = negative_log_likelihood(
        lambda x, t: nets.body(x, t, code[body_rows], along, steered[body_rows]), batch.body[body_rows]
    )
    return goal_loss | {"path": path.mean(), "body": mean_of_known(body, known)}


def negative_log_likelihood(
    predict: Denoise, clean: Float[Tensor, "batch ..."]
) -> Float[Tensor, "batch ..."]:
    """Return -log N(clean; mean, std), of which ``predict`` returns mean and log std at two steps, shown no
    sample.
    """
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
    """Return the denoising errors of path and body as one sequence without control; perception learns with
    them.
    """
    assert phase == "all", "a model of one stage has no goals that could learn before"
    code = perceive(nets, batch, objective, generator)
    known = ~batch.mirrored
    seen = torch.where(known[:, None, None], batch.body, torch.zeros_like(batch.body))
    whole = torch.cat([batch.path, seen], dim=1)
    nothing = torch.zeros_like(batch.places), torch.zeros(len(code), 1, device=code.device)
    error = squared_error(
        lambda x, t: nets.body(x, t, code, *nothing), whole, schedule, objective.weighting, generator
    )
    body = error[:, PATH_CHANNELS:] * known[:, None, None]
    return {
        "path": error[:, :PATH_CHANNELS].mean(),
        "body": body.sum() / max(int(known.sum()) * body[0].numel(), 1),
    }
