"""Denoising losses of goal, path and body (Eq. 8), with condition dropout for classifier-free guidance."""

import contextlib
from collections.abc import Callable
from dataclasses import replace
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
"""Maps noisy samples and their steps to the predicted noise"""
SequenceError = Callable[[Denoise, Float[Tensor, "row ..."]], Float[Tensor, "row ..."]]
CONDITION_DROPOUT = 0.1
"""Probability of replacing a condition by its null, independently, for classifier-free guidance"""
FORESEEN_SHARE = 0.5
"""Share of samples of paths and bodies in which it is known where the observer will be, and weight of goals
that know it beside the same goals that do not: if half of the goals know it, the others get worse"""
EARLIEST_GOAL = 0.2
"""Earliest time of training targets of goals, as a share of the horizon"""
MOTION_WEIGHT: dict[Weighting, float] = {"noise": 0.0, "velocity": 4.0, "flow": 4.0}
"""Weight of the frame-to-frame change of a body's error beside the error itself, like the velocity loss of
Tevet et al. 2022: errors that change make feet skate. The paper's loss has none."""
TrainingPhase = Literal["goals", "sequences", "all"]
"""Trained networks: perception and goals; path and body, with frozen perception; or all"""


def losses(
    nets: BehaviorNets,
    batch: TrainingBatch,
    schedule: Schedule,
    objective: ObjectiveConfig,
    generator: torch.Generator,
    *,
    phase: TrainingPhase = "all",
) -> dict[str, Float[Tensor, ""]]:
    """Return the weighted mean squared error of the predicted noise of each network trained in ``phase``."""

    def goal(code: Tensor) -> Tensor:
        return goal_error(nets, batch, code, schedule, objective, generator)

    def error(denoise: Denoise, clean: Tensor, motion_weight: float | None = None) -> Tensor:
        return squared_error(denoise, clean, schedule, objective.weighting, generator, motion_weight)

    of_body = partial(error, motion_weight=MOTION_WEIGHT[objective.weighting])
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
    """Return the mean error of goal, path and body, each conditioned on the level above it.

    ``goal`` takes the perception code. Bodies have no loss if their share of the batch is 0.
    """
    joint, foreseen = joint_mask(batch, objective, generator), batch
    batch = partly_foreseen(nets, batch, 0.0 if phase == "goals" else FORESEEN_SHARE, generator)
    with torch.no_grad() if phase == "sequences" else contextlib.nullcontext():
        code = perceive(nets, batch, objective, generator, joint)
    goal_loss = {} if phase == "sequences" else {"goal": goal(code).mean()}
    if phase == "goals":
        if not nets.perception.first.others.anticipates:
            return goal_loss
        informed = goal(perceive(nets, foreseen, objective, generator, joint)).mean()
        return {"goal": (goal_loss["goal"] + FORESEEN_SHARE * informed) / (1 + FORESEEN_SHARE)}
    path_rows, body_rows, known = sequence_rows(batch, objective)
    control_keep = keep_mask(len(code), 1, generator).to(code.device) * joint
    towards, along = batch.goal[path_rows], batch.places[body_rows]
    path = path_error(
        lambda x, t: nets.path(x, t, code[path_rows], towards, control_keep[path_rows]), batch.path[path_rows]
    )
    if not len(body_rows):
        return goal_loss | {"path": path.mean()}
    body = body_error(
        lambda x, t: nets.body(x, t, code[body_rows], along, control_keep[body_rows]), batch.body[body_rows]
    )
    # over the known rows of all processes; root and bones have equal weight
    each = (body[:, :ROOT_CHANNELS].mean((1, 2)) + body[:, ROOT_CHANNELS:].mean((1, 2))) / 2
    count = distributed.mean(known.sum().float()).clamp_min(1 / distributed.size())
    return goal_loss | {"path": path.mean(), "body": (each * known).sum() / count}


def partly_foreseen(
    nets: BehaviorNets, batch: TrainingBatch, share: float, generator: torch.Generator
) -> TrainingBatch:
    """Return the batch with where observers will be in a random ``share`` of samples; else it is unknown."""
    others = batch.others.clone()
    unknown = torch.rand(len(others), generator=generator).to(others.device) >= share
    others[unknown, :, nets.perception.first.past.frames :, 0] = ABSENT_M
    return replace(batch, others=others)


def sequence_rows(
    batch: TrainingBatch, objective: ObjectiveConfig
) -> tuple[Int[Tensor, "path"], Int[Tensor, "body"], Bool[Tensor, "body"]]:
    """Return the rows that train paths, those that train bodies, and which of the latter have known bones.

    Their numbers are the same in every step, since each size compiles new kernels. Rows with unknown bones
    (mirrored, of other homes) are chosen last.
    """
    shares = objective.path_share, objective.body_share
    paths, bodies = (max(round(len(batch.goal) * share), 1) for share in shares)
    bodies = bodies if objective.body_share > 0 else 0
    body = torch.argsort((~batch.bones_known).int(), stable=True)[:bodies]
    return torch.arange(paths, device=body.device), body, batch.bones_known[body]


def perceive(
    nets: BehaviorNets,
    batch: TrainingBatch,
    objective: ObjectiveConfig,
    generator: torch.Generator,
    joint: Float[Tensor, "batch 1"],
) -> Float[Tensor, "batch condition"]:
    """Encode a batch, dropping scene, others and past independently, and all where ``joint`` is 0.

    All members of the ensemble drop the same conditions.
    """
    keep = keep_mask(len(batch.goal), 3, generator).to(batch.goal.device) * joint
    keep[:, 1] = torch.maximum(keep[:, 1], batch.oversampled.float())
    others = with_some_absent(batch.others, batch.oversampled, generator)
    encodings = []
    for member in nets.perception:
        scene, past = member.scene.encode(batch.scene), member.past(batch.past, batch.bones_keep)
        scene_map, code, attended = member.join(scene, others, past, keep)
        encodings.append((scene_map, nn.functional.dropout(code, objective.code_dropout), attended))
    return nets.perception.condition(encodings, nets.perception.now(batch.held, keep[:, 2]))


def with_some_absent(
    others: Float[Tensor, "batch other past_frame 10"],
    oversampled: Bool[Tensor, "batch"],
    generator: torch.Generator,
) -> Float[Tensor, "batch other past_frame 10"]:
    """Drop each of several others independently, so that guidance can act on each."""
    size, count = others.shape[:2]
    if count == 1:  # dropped with the condition as a whole
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
    """Return the error of goals, mean over members."""
    clean, horizon = goal_targets(batch, objective, generator)
    error = squared_error(
        lambda x, t: nets.goal.per_member(x, t, code, horizon),
        clean, schedule, objective.weighting, generator,
    )  # fmt: skip
    return error.mean(0)


def goal_targets(
    batch: TrainingBatch, objective: ObjectiveConfig, generator: torch.Generator
) -> tuple[Float[Tensor, "draw 3"], Float[Tensor, "draw"]]:
    """Return several goals of each window and their times as shares of the horizon; some are earlier."""
    draws, frames, device = objective.goal_draws, batch.track.shape[-1], batch.track.device
    count = len(batch.track) * draws
    earlier = torch.rand(count, generator=generator) < objective.earlier_share
    drawn = torch.randint(round(EARLIEST_GOAL * frames), frames, (count,), generator=generator)
    frame = torch.where(earlier, drawn, frames - 1).to(device)
    return batch.track[torch.arange(count, device=device) // draws, :, frame], (frame + 1) / frames


def keep_mask(size: int, count: int, generator: torch.Generator) -> Float[Tensor, "batch count"]:
    """Draw 0 with probability `CONDITION_DROPOUT`, else 1."""
    return (torch.rand(size, count, generator=generator) >= CONDITION_DROPOUT).float()


def joint_mask(
    batch: TrainingBatch, objective: ObjectiveConfig, generator: torch.Generator
) -> Float[Tensor, "batch 1"]:
    """Draw 0 where all conditions are dropped together, else 1; no random draws if that never happens."""
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
    motion_weight: float | Float[Tensor, "channel 1"] | None = None,
) -> Float[Tensor, "batch ..."]:
    """Return the squared error at a random step of the predicted noise, velocity, or flow (noise - clean).

    Given the noisy sample, these differ only by a factor of the step. ``motion_weight`` weights the squared
    frame-to-frame change of the error of a sequence; if errors of frames are independent, the mean does not
    depend on it.
    """
    t = torch.randint(schedule.steps, (len(clean),), generator=generator)
    alpha_bar = torch.from_numpy(schedule.alpha_bar).float()
    alpha_bar_t = alpha_bar[t].reshape(-1, *[1] * (clean.ndim - 1)).to(clean.device)
    noise = torch.randn(clean.shape, generator=generator).to(clean.device)
    residual = denoise(noised(clean, noise, alpha_bar_t), t.float().to(clean.device)) - noise
    error = residual**2
    if motion_weight is not None:
        change = nn.functional.pad(residual.diff(dim=-1), (1, 0)) ** 2
        error = (error + motion_weight * change) / (1 + 2 * motion_weight)
    match weighting:
        case "noise":
            return error
        case "velocity":
            return error / alpha_bar_t
        case "flow":
            return error * (1 + ((1 - alpha_bar_t) / alpha_bar_t).sqrt()) ** 2
        case _:
            assert_never(weighting)
