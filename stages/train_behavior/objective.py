"""The denoising losses of goal, path and body (Eq. 8), with conditions dropped at random for guidance."""

import contextlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from pipeline.models.behavior import BehaviorNets
from pipeline.models.diffusion import Schedule, noised
from stages.train_behavior.batches import Batch

Denoise = Callable[[Tensor, Tensor], Tensor]
"""From noisy samples and their steps to the noise"""


@dataclass(frozen=True)
class Objective:
    """How a batch becomes losses."""

    drop: float = 0.1
    """probability that a condition is replaced by its null, for each condition on its own"""
    code_dropout: float = 0.1
    """dropout on the perception code"""
    weighting: Literal["noise", "velocity"] = "velocity"
    """which error counts evenly at all steps: that of the noise, as in the paper, or that of the velocity, which gives
    the noisy steps, where the outline is decided, their share"""
    goal_draws: int = 8
    """noise levels drawn per window for the goal, whose network is small"""


def losses(
    nets: BehaviorNets,
    batch: Batch,
    schedule: Schedule,
    objective: Objective,
    generator: torch.Generator,
    *,
    goals: bool = True,
) -> dict[str, Tensor]:
    """Return the weighted mean squared error of the predicted noise, per network.

    Without ``goals`` perception and goal network rest: their weights get no gradient, and the goal's error only tells.
    """
    with contextlib.nullcontext() if goals else torch.no_grad():
        code = perceive(nets, batch, objective, generator)
    draws = objective.goal_draws

    def error(denoise: Denoise, clean: Tensor) -> Tensor:
        return squared_error(denoise, clean, schedule, objective.weighting, generator)

    repeated = code.repeat_interleave(draws, 0)
    with contextlib.nullcontext() if goals else torch.no_grad():
        goal = error(lambda x, t: nets.goal(x, t, repeated), batch.goal.repeat_interleave(draws, 0))
    steered = kept(len(code), 1, objective.drop, generator).to(code.device)
    path = error(lambda x, t: nets.path(x, t, code, batch.goal, steered), batch.path)
    known = ~batch.mirrored
    along = batch.path[known]
    body = error(lambda x, t: nets.body(x, t, code[known], along, steered[known]), batch.body[known])
    return {"goal": goal.mean(), "path": path.mean(), "body": body.sum() / max(body.numel(), 1)}


def perceive(nets: BehaviorNets, batch: Batch, objective: Objective, generator: torch.Generator) -> Float[Tensor, "batch condition"]:
    """Encode a batch, dropping scene, observer and past independently."""
    keep = kept(len(batch.goal), 3, objective.drop, generator).to(batch.goal.device)
    network = nets.perception
    scene = network.scene.encode(batch.scene)
    code = network.join(scene, batch.observer_past, network.past(batch.past, batch.bones_keep), keep)
    return nn.functional.dropout(code, objective.code_dropout)


def kept(size: int, count: int, drop: float, generator: torch.Generator) -> Float[Tensor, "batch count"]:
    """Draw 1 with probability ``1 - drop``, else 0."""
    return (torch.rand(size, count, generator=generator) >= drop).float()


def squared_error(
    denoise: Denoise,
    clean: Float[Tensor, "batch ..."],
    schedule: Schedule,
    weighting: Literal["noise", "velocity"],
    generator: torch.Generator,
) -> Float[Tensor, "batch ..."]:
    """Noise ``clean`` to a random step and compare the noise, or the velocity, with its prediction."""
    t = torch.randint(schedule.steps, (len(clean),), generator=generator)
    share = torch.from_numpy(schedule.alpha_bar).float()[t].reshape(-1, *[1] * (clean.ndim - 1)).to(clean.device)
    noise = torch.randn(clean.shape, generator=generator).to(clean.device)
    error = (denoise(noised(clean, noise, share), t.float().to(clean.device)) - noise) ** 2
    return error / share if weighting == "velocity" else error
