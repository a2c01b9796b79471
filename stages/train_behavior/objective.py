"""The denoising losses of goal, path and body (Eq. 8), with conditions dropped at random for guidance."""

import contextlib
from collections.abc import Callable
from functools import partial
from typing import Literal, assert_never

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from pipeline.behavior.diffusion import Schedule, noised
from pipeline.behavior.model import ROOT_CHANNELS, BehaviorNets
from pipeline.behavior.trajectories import ABSENT_M
from pipeline.core import distributed
from stages.train_behavior.batches import TrainingBatch
from stages.train_behavior.config import ObjectiveConfig, Weighting

Denoise = Callable[[Tensor, Tensor], Tensor]
"""From noisy samples and their steps to the noise"""
SequenceError = Callable[[Denoise, Float[Tensor, "row ..."]], Float[Tensor, "row ..."]]
CONDITION_DROPOUT = 0.1
"""Probability that a condition is replaced by its null, each on its own, for classifier-free guidance"""
EARLIEST_GOAL = 0.2
"""Earliest time that goals are trained for, as a share of the horizon"""
TrainingPhase = Literal["goals", "sequences", "all"]
"""What learns: perception and goals; path and body, of a perception that rests; or all at once"""


def losses(
    nets: BehaviorNets,
    batch: TrainingBatch,
    schedule: Schedule,
    objective: ObjectiveConfig,
    generator: torch.Generator,
    *,
    phase: TrainingPhase = "all",
) -> dict[str, Float[Tensor, ""]]:
    """Return the weighted mean squared error of the predicted noise, per network.

    Only what learns has an error.
    """

    def goal(code: Tensor) -> Tensor:
        return goal_error(nets, batch, code, schedule, objective, generator)

    def error(denoise: Denoise, clean: Tensor, motion_weight: float = 0.0) -> Tensor:
        return squared_error(denoise, clean, schedule, objective.weighting, generator, motion_weight)

    of_body = partial(error, motion_weight=objective.motion_weight)
    return level_losses(nets, batch, objective, generator, phase, goal, error, of_body)


def level_losses(
    nets: BehaviorNets,
    batch: TrainingBatch,
    objective: ObjectiveConfig,
    generator: torch.Generator,
    phase: TrainingPhase,
    goal: Callable[[Float[Tensor, "batch condition"]], Float[Tensor, "draw 3"]],
    path_error: SequenceError,
    body_error: SequenceError,
) -> dict[str, Float[Tensor, ""]]:
    """Return the mean error of goal, path and body, each given the level above it; ``goal`` takes the
    perception code. Without a share of the windows a body learns nothing.
    """
    joint = joint_mask(batch, objective, generator)
    with torch.no_grad() if phase == "sequences" else contextlib.nullcontext():
        code = perceive(nets, batch, objective, generator, joint)
    goal_loss = {} if phase == "sequences" else {"goal": goal(code).mean()}
    if phase == "goals":
        return goal_loss
    path_rows, body_rows, known = sequence_rows(batch, objective)
    steered = keep_mask(len(code), 1, generator).to(code.device) * joint
    towards, along = batch.goal[path_rows], batch.places[body_rows]
    path = path_error(
        lambda x, t: nets.path(x, t, code[path_rows], towards, steered[path_rows]), batch.path[path_rows]
    )
    if not len(body_rows):
        return goal_loss | {"path": path.mean()}
    body = body_error(
        lambda x, t: nets.body(x, t, code[body_rows], along, steered[body_rows]), batch.body[body_rows]
    )
    return goal_loss | {"path": path.mean(), "body": mean_of_known(body, known)}


def sequence_rows(
    batch: TrainingBatch, objective: ObjectiveConfig
) -> tuple[Int[Tensor, "path"], Int[Tensor, "body"], Bool[Tensor, "body"]]:
    """Return the windows from which paths learn, those from which bodies learn, and which of the latter have
    true bones.

    Both are always as many in every step, for kernels are made anew for every size. Windows whose bones are
    unknown (mirrored, of other homes) come last among the bodies.
    """
    shares = objective.path_share, objective.body_share
    paths, bodies = (max(round(len(batch.goal) * share), 1) for share in shares)
    bodies = bodies if objective.body_share > 0 else 0
    body = torch.argsort((~batch.bones_known).int(), stable=True)[:bodies]
    return torch.arange(paths, device=body.device), body, batch.bones_known[body]


def mean_of_known(error: Float[Tensor, "row channel frame"], known: Bool[Tensor, "row"]) -> Float[Tensor, ""]:
    """Return the mean over known rows of all processes; root and bones count for a half each."""
    each = (error[:, :ROOT_CHANNELS].mean((1, 2)) + error[:, ROOT_CHANNELS:].mean((1, 2))) / 2
    return (each * known).sum() / distributed.mean(known.sum().float()).clamp_min(1 / distributed.size())


def perceive(
    nets: BehaviorNets,
    batch: TrainingBatch,
    objective: ObjectiveConfig,
    generator: torch.Generator,
    joint: Float[Tensor, "batch 1"],
) -> Float[Tensor, "batch condition"]:
    """Encode a batch, dropping scene, others and past independently, and all where ``joint`` is 0.

    What is dropped is so for every member alike.
    """
    keep = keep_mask(len(batch.goal), 3, generator).to(batch.goal.device) * joint
    keep[:, 1] = torch.maximum(keep[:, 1], batch.oversampled.float())
    others = with_some_absent(batch.others, batch.oversampled, generator)
    encodings = [
        member.encode_training(batch.scene, others, batch.past, keep, batch.bones_keep)
        for member in nets.perception
    ]
    dropout = objective.code_dropout
    encodings = [(scene_map, nn.functional.dropout(code, dropout)) for scene_map, code in encodings]
    return nets.perception.condition(encodings, nets.perception.now(batch.held, keep[:, 2]))


def with_some_absent(
    others: Float[Tensor, "batch other past_frame 10"],
    oversampled: Bool[Tensor, "batch"],
    generator: torch.Generator,
) -> Float[Tensor, "batch other past_frame 10"]:
    """Return the others with each of several left out at times, so that each can be guided on its own."""
    size, count = others.shape[:2]
    if count == 1:  # who is left out with the condition as a whole
        return others
    present = keep_mask(size, count, generator).to(others.device)
    present[:, 0] = torch.maximum(present[:, 0], oversampled.float())
    absent = torch.zeros_like(others[0, 0, 0])
    absent[0] = ABSENT_M
    return torch.where(present[..., None, None] > 0, others, absent)


def goal_error(
    nets: BehaviorNets,
    batch: TrainingBatch,
    code: Float[Tensor, "batch condition"],
    schedule: Schedule,
    objective: ObjectiveConfig,
    generator: torch.Generator,
) -> Float[Tensor, "draw 3"]:
    """Return the error of the goals, mean over members; some of the draws ask for earlier times."""
    draws, frames = objective.goal_draws, batch.track.shape[-1]
    count = len(code) * draws
    earlier = torch.rand(count, generator=generator) < objective.earlier_share
    drawn = torch.randint(round(EARLIEST_GOAL * frames), frames, (count,), generator=generator)
    frame = torch.where(earlier, drawn, frames - 1).to(code.device)
    row = torch.arange(count, device=code.device) // draws
    horizon = (frame + 1) / frames
    clean, weighting = batch.track[row, :, frame], objective.weighting
    error = squared_error(
        lambda x, t: nets.goal.per_member(x, t, code, horizon), clean, schedule, weighting, generator
    )
    return error.mean(0)


def keep_mask(size: int, count: int, generator: torch.Generator) -> Float[Tensor, "batch count"]:
    """Draw 1 with probability ``1 - drop``, else 0."""
    return (torch.rand(size, count, generator=generator) >= CONDITION_DROPOUT).float()


def joint_mask(
    batch: TrainingBatch, objective: ObjectiveConfig, generator: torch.Generator
) -> Float[Tensor, "batch 1"]:
    """Draw 0 where all conditions are dropped together, else 1; draws nothing where none are."""
    size, device = len(batch.goal), batch.goal.device
    if objective.joint_dropout == 0:
        return torch.ones(size, 1, device=device)
    return (torch.rand(size, 1, generator=generator) >= objective.joint_dropout).float().to(device)


def squared_error(
    denoise: Denoise,
    clean: Float[Tensor, "batch ..."],
    schedule: Schedule,
    weighting: Weighting,
    generator: torch.Generator,
    motion_weight: float | Float[Tensor, "channel 1"] = 0.0,
) -> Float[Tensor, "batch ..."]:
    """Noise ``clean`` to a random step and compare the noise, the velocity or noise less clean sample with
    its prediction.

    All three are the error of the noise, for the noisy sample is given, by a factor of the step. Beside the
    error of a sequence counts its change from frame to frame, by ``motion_weight``; errors that do not depend
    on the frame's neighbours have the same mean with any weight.
    """
    t = torch.randint(schedule.steps, (len(clean),), generator=generator)
    alpha_bar = torch.from_numpy(schedule.alpha_bar).float()
    share = alpha_bar[t].reshape(-1, *[1] * (clean.ndim - 1)).to(clean.device)
    noise = torch.randn(clean.shape, generator=generator).to(clean.device)
    residual = denoise(noised(clean, noise, share), t.float().to(clean.device)) - noise
    error = residual**2
    if clean.ndim > 2:
        change = nn.functional.pad(residual.diff(dim=-1), (1, 0)) ** 2
        error = (error + motion_weight * change) / (1 + 2 * motion_weight)
    match weighting:
        case "noise":
            return error
        case "velocity":
            return error / share
        case "flow":
            return error * (1 + ((1 - share) / share).sqrt()) ** 2
        case _:
            assert_never(weighting)
