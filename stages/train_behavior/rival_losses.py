"""What the rival models of Table 4 minimise, on the same batches and with the same dropping of conditions."""

import contextlib
import math

import torch
from jaxtyping import Float
from torch import Tensor

from pipeline.models.behavior import BehaviorNets
from pipeline.models.diffusion import Schedule
from pipeline.models.rivals import LOG_STD, MEAN, SPREAD
from pipeline.models.strides import STRIDE
from stages.train_behavior.batches import Batch
from stages.train_behavior.objective import Denoise, Objective, Part, kept, mean_of_known, perceive, sequence_rows, squared_error


def gaussian_losses(
    nets: BehaviorNets, batch: Batch, schedule: Schedule, objective: Objective, generator: torch.Generator, *, part: Part = "all"
) -> dict[str, Tensor]:
    """Return the negative log-likelihood per number of goal, path and body, each given the level above it."""
    del schedule
    with torch.no_grad() if part == "sequences" else contextlib.nullcontext():
        code = perceive(nets, batch, objective, generator)
        goal = negative_log_likelihood(lambda x, t: nets.goal(x, t, code), batch.goal).mean()
    told = {} if part == "sequences" else {"goal": goal}
    if part == "goals":
        return told
    path_rows, body_rows, known = sequence_rows(batch, objective)
    steered = kept(len(code), 1, objective.drop, generator).to(code.device)
    towards, along = batch.goal[path_rows], batch.places[body_rows]
    path = negative_log_likelihood(lambda x, t: nets.path(x, t, code[path_rows], towards, steered[path_rows]), batch.path[path_rows])
    body = negative_log_likelihood(lambda x, t: nets.body(x, t, code[body_rows], along, steered[body_rows]), batch.body[body_rows])
    return told | {"path": path.mean(), "body": mean_of_known(body, known)}


def negative_log_likelihood(tell: Denoise, clean: Float[Tensor, "batch ..."]) -> Float[Tensor, "batch ..."]:
    """Return -log N(clean; mean, std), of which ``tell`` gives mean and log std at two steps, shown no sample."""
    nothing = torch.zeros_like(clean)
    mean, log_std = (tell(nothing, torch.full((len(clean),), step, device=clean.device)) for step in (MEAN, SPREAD))
    log_std = log_std.clamp(*LOG_STD)
    return 0.5 * ((clean - mean) * torch.exp(-log_std)) ** 2 + log_std + 0.5 * math.log(2 * math.pi)


def one_stage_losses(
    nets: BehaviorNets, batch: Batch, schedule: Schedule, objective: Objective, generator: torch.Generator, *, part: Part = "all"
) -> dict[str, Tensor]:
    """Return the denoising errors of path and body as one sequence without control; perception learns with them."""
    assert part == "all", "a model of one stage has no goals that could learn before"
    code = perceive(nets, batch, objective, generator)
    known = ~batch.mirrored
    seen = torch.where(known[:, None, None], batch.body, torch.zeros_like(batch.body))
    whole = torch.cat([batch.path, seen], dim=1)
    nothing = torch.zeros_like(batch.places), torch.zeros(len(code), 1, device=code.device)
    error = squared_error(lambda x, t: nets.body(x, t, code, *nothing), whole, schedule, objective.weighting, generator)
    body = error[:, STRIDE:] * known[:, None, None]
    return {"path": error[:, :STRIDE].mean(), "body": body.sum() / max(int(known.sum()) * body[0].numel(), 1)}
