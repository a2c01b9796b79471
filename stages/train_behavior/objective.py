"""The denoising losses of goal, path and body (Eq. 8), with conditions dropped at random for guidance."""

import contextlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, assert_never

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from pipeline.models.behavior import ROOT_CHANNELS, BehaviorNets
from pipeline.models.diffusion import Schedule, noised
from stages.train_behavior.batches import Batch

Denoise = Callable[[Tensor, Tensor], Tensor]
"""From noisy samples and their steps to the noise"""
Weighting = Literal["noise", "velocity", "flow"]
"""Which error counts evenly at all steps, see `squared_error`"""
Part = Literal["goals", "sequences", "all"]
"""What learns: perception and goals; path and body, of a perception that rests; or all at once"""


@dataclass(frozen=True)
class Objective:
    """How a batch becomes losses."""

    drop: float = 0.1
    """probability that a condition is replaced by its null, for each condition on its own"""
    code_dropout: float = 0.1
    """dropout on the perception code"""
    weighting: Weighting = "velocity"
    """which error counts evenly at all steps: that of the noise, as in the paper, that of the velocity, which gives the
    noisy steps, where the outline is decided, their share, or that of the straight way of rectified flow"""
    path_share: float = 0.5
    """share of a batch's windows from which paths, whose network costs much, learn in a step"""
    body_share: float = 0.5
    """share of a batch's windows from which bodies, whose network costs the most, learn in a step"""
    goal_draws: int = 8
    """noise levels drawn per window for the goal, whose network is small"""
    earlier_share: float = 0.7
    """share of those draws that ask where the animal is before the 5.6 s are over: minutes of video hold few goals"""
    earliest: float = 0.2
    """earliest time that they ask for, as a part of the 5.6 s"""


def losses(
    nets: BehaviorNets,
    batch: Batch,
    schedule: Schedule,
    objective: Objective,
    generator: torch.Generator,
    *,
    part: Part = "all",
) -> dict[str, Tensor]:
    """Return the weighted mean squared error of the predicted noise, per network.

    Only what learns has an error.
    """
    with torch.no_grad() if part == "sequences" else contextlib.nullcontext():
        code = perceive(nets, batch, objective, generator)
    told = {} if part == "sequences" else {"goal": goal_error(nets, batch, code, schedule, objective, generator).mean()}
    if part == "goals":
        return told

    def error(denoise: Denoise, clean: Tensor) -> Tensor:
        return squared_error(denoise, clean, schedule, objective.weighting, generator)

    path_rows, body_rows, known = sequence_rows(batch, objective)
    steered = kept(len(code), 1, objective.drop, generator).to(code.device)
    towards, along = batch.goal[path_rows], batch.places[body_rows]
    path = error(lambda x, t: nets.path(x, t, code[path_rows], towards, steered[path_rows]), batch.path[path_rows])
    body = error(lambda x, t: nets.body(x, t, code[body_rows], along, steered[body_rows]), batch.body[body_rows])
    return told | {"path": path.mean(), "body": mean_of_known(body, known)}


def sequence_rows(batch: Batch, objective: Objective) -> tuple[Int[Tensor, "path"], Int[Tensor, "body"], Bool[Tensor, "body"]]:
    """Return the windows from which paths learn, those from which bodies learn, and which of the latter tell true bones.

    Both are always as many in every step, for kernels are made anew for every size. Mirrored windows, whose bones nobody
    knows, come last among the bodies.
    """
    paths, bodies = (max(round(len(batch.goal) * share), 1) for share in (objective.path_share, objective.body_share))
    body = torch.argsort(batch.mirrored.int(), stable=True)[:bodies]
    return torch.arange(paths, device=body.device), body, ~batch.mirrored[body]


def mean_of_known(error: Float[Tensor, "row channel frame"], known: Bool[Tensor, "row"]) -> Float[Tensor, ""]:
    """Return the mean over the rows that are known (0 where none is), in which root and bones count for a half each."""
    each = (error[:, :ROOT_CHANNELS].mean((1, 2)) + error[:, ROOT_CHANNELS:].mean((1, 2))) / 2
    return (each * known).sum() / known.sum().clamp_min(1)


def perceive(nets: BehaviorNets, batch: Batch, objective: Objective, generator: torch.Generator) -> Float[Tensor, "batch condition"]:
    """Encode a batch, dropping scene, observer and past independently, for every mind alike."""
    keep = kept(len(batch.goal), 3, objective.drop, generator).to(batch.goal.device)
    keep[:, 1] = torch.maximum(keep[:, 1], batch.chosen.float())
    readings = [mind.training_code(batch.scene, batch.observer_past, batch.past, keep, batch.bones_keep) for mind in nets.perception]
    readings = [(chart, nn.functional.dropout(code, objective.code_dropout)) for chart, code in readings]
    return nets.perception.condition(readings, nets.perception.now(batch.held, keep[:, 2]))


def goal_error(
    nets: BehaviorNets,
    batch: Batch,
    code: Float[Tensor, "batch condition"],
    schedule: Schedule,
    objective: Objective,
    generator: torch.Generator,
) -> Float[Tensor, "draw 3"]:
    """Return the error of the goals, each mind's on its own, averaged; some of the draws ask for earlier times."""
    draws, frames = objective.goal_draws, batch.track.shape[-1]
    count = len(code) * draws
    earlier = torch.rand(count, generator=generator) < objective.earlier_share
    drawn = torch.randint(round(objective.earliest * frames), frames, (count,), generator=generator)
    frame = torch.where(earlier, drawn, frames - 1).to(code.device)
    row = torch.arange(count, device=code.device) // draws
    horizon = (frame + 1) / frames
    return squared_error(
        lambda x, t: nets.goal.apart(x, t, code, horizon), batch.track[row, :, frame], schedule, objective.weighting, generator
    ).mean(0)


def kept(size: int, count: int, drop: float, generator: torch.Generator) -> Float[Tensor, "batch count"]:
    """Draw 1 with probability ``1 - drop``, else 0."""
    return (torch.rand(size, count, generator=generator) >= drop).float()


def squared_error(
    denoise: Denoise,
    clean: Float[Tensor, "batch ..."],
    schedule: Schedule,
    weighting: Weighting,
    generator: torch.Generator,
) -> Float[Tensor, "batch ..."]:
    """Noise ``clean`` to a random step and compare the noise, the velocity or noise less clean sample with its prediction.

    All three are the error of the noise, for the noisy sample is given, by a factor that the step tells.
    """
    t = torch.randint(schedule.steps, (len(clean),), generator=generator)
    share = torch.from_numpy(schedule.alpha_bar).float()[t].reshape(-1, *[1] * (clean.ndim - 1)).to(clean.device)
    noise = torch.randn(clean.shape, generator=generator).to(clean.device)
    error = (denoise(noised(clean, noise, share), t.float().to(clean.device)) - noise) ** 2
    match weighting:
        case "noise":
            return error
        case "velocity":
            return error / share
        case "flow":
            return error * (1 + ((1 - share) / share).sqrt()) ** 2
        case _:
            assert_never(weighting)
