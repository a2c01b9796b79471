"""Run the phases in order: copy the agent template, fit the scene, pose the template, fit everything.

Each phase is one call of `pipeline.fit.fit` with its own checkpoints, so that a killed run goes on where it was.
"""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch
from torch import nn

from pipeline import progress, threads, together
from pipeline.fit import FitRecord, fit, generator_for, termination
from stages.reconstruct import stances
from stages.reconstruct.joint import JointLoss, TemplateLoss
from stages.reconstruct.posing import Chunk, ChunkLoss
from stages.reconstruct.problem import Problem
from stages.reconstruct.scene import SceneLoss
from stages.reconstruct.settings import Batches, Rates, Steps, Weights

Result = TypeVar("Result")


@dataclass(frozen=True)
class Plan:
    """How to optimise."""

    steps: Steps
    weights: Weights
    batches: Batches
    rates: Rates
    seed: int
    resume: Path | None
    """folder for checkpoints"""
    workers: int = 1
    """stretches that are posed at once, each by one thread"""


def cosine(progress: float) -> float:
    """Fall from 1 to a twentieth."""
    return 0.05 + 0.95 * 0.5 * (1 + math.cos(math.pi * progress))


@threads.alone()
def optimise(problem: Problem, plan: Plan) -> dict[str, FitRecord]:
    """Run all phases; the modules of the problem change in place. Returns the losses of each phase.

    Several processes (`pipeline.together`) share the videos: each looks at its own ones' rays, and poses the template in them.
    """
    steps, rates, everything = plan.steps, plan.rates, problem
    if together.size() > 1:
        problem = problem.share(together.rank(), together.size())
        plan = replace(plan, batches=plan.batches.share(together.size()))
    records = {}
    records["template"] = _run(problem, plan, "template", TemplateLoss(problem), steps.template, field_groups(problem.agent, rates))
    scene = [*field_groups(problem.scene, rates), _motion_group([problem.motion.camera], rates.camera, momentum=0.9)]
    records["scene"] = _run(problem, plan, "scene", SceneLoss(problem, plan.weights, plan.batches, steps.scene), steps.scene, scene)
    if len(everything.agent_frames):
        stretches = list(chunks(everything, steps.body_chunk_frames))
        _stand(problem, plan, stretches)
        _pose(problem, plan, stretches)
        for corrections in (problem.motion.root, problem.motion.bone):
            corrections.data.copy_(together.total(corrections))
        records["joint"] = _run(
            problem, plan, "joint", JointLoss(problem, plan.weights, plan.batches, steps.joint), steps.joint, joint_groups(problem, rates)
        )
    return records


def chunks(problem: Problem, length: int) -> Iterable[torch.Tensor]:
    """Cut each video's frames into stretches that hold at least one usable frame."""
    for video in range(int(problem.video.max()) + 1):
        frames = torch.nonzero(problem.video == video)[:, 0]
        for part in frames.split(length):
            if torch.isin(part, problem.agent_frames).any():
                yield part


def _run(problem: Problem, plan: Plan, name: str, loss, steps: int, groups: list[dict]) -> FitRecord:
    return fit(
        modules=problem.modules(),
        optimizer=torch.optim.AdamW(groups, lr=1.0),
        loss=loss,
        steps=steps,
        seed=_seed(plan.seed, name),
        resume=plan.resume / name if plan.resume else None,
        save_every=min(plan.steps.save_every, max(steps, 1)),
        schedule=cosine,
        label=name,
        clip_norm=10.0,
        shared=True,
    )


def _pose(problem: Problem, plan: Plan, stretches: Sequence[torch.Tensor]) -> None:
    """Pose the template in all stretches with usable frames and write roots and bones into the motion table."""

    def pose(index: int, frame: torch.Tensor, asked_to_stop: Callable[[], bool]) -> Chunk:
        chunk = Chunk(problem, frame)
        _fit_chunk(problem, plan, f"body_{index:04d}", chunk, plan.steps.body, asked_to_stop)
        return chunk

    for chunk in _in_each(problem, plan, stretches, pose, "posing"):
        chunk.write(problem)


def _stand(problem: Problem, plan: Plan, stretches: Sequence[torch.Tensor]) -> None:
    """Find in all stretches with usable frames how the agent stands, by half as many rays as pose it, and let its roots start so."""
    choices, chosen = stances.known(problem), torch.zeros_like(problem.video)
    batches = plan.batches
    plan = replace(plan, batches=replace(batches, posed_rays=batches.posed_rays // 2, posed_points=batches.posed_points // 2))

    def told(index: int, frame: torch.Tensor, asked_to_stop: Callable[[], bool]) -> tuple[torch.Tensor, np.ndarray]:
        losses = []
        for number, stance in enumerate(choices):
            chunk, name = Chunk(problem, frame, stance), f"stance_{index:04d}_{number}"
            loss = _fit_chunk(problem, plan, name, chunk, plan.steps.stance, asked_to_stop)
            losses.append(loss.of_parts(stances.PART, generator_for(plan.seed, index)))
        return frame, torch.stack(losses, dim=-1).cpu().numpy()

    losses = list(_in_each(problem, plan, stretches, told, "stances"))
    usual = float(np.nanmedian(np.concatenate([loss[:, 0] for _, loss in losses])))
    for frame, loss in losses:
        chosen[frame] = stances.by_frame(stances.likeliest(loss, usual), len(frame)).to(chosen)
    lean, bone = (torch.stack([getattr(stance, name) for stance in choices]) for name in ("lean", "bone"))
    problem.motion.start(lean[together.total(chosen)], bone[chosen])


def _in_each(problem: Problem, plan: Plan, stretches: Sequence[torch.Tensor], work: Callable[..., Result], label: str) -> Iterator[Result]:
    """Yield what is found in each stretch with usable frames, given its number and its frames; only chunks learn meanwhile."""
    held = [problem.agent, problem.body, problem.scene]
    own = [(index, frame) for index, frame in enumerate(stretches) if torch.isin(frame, problem.agent_frames).any()]
    for module in held:
        module.requires_grad_(False)
    with termination() as asked_to_stop:
        found = threads.ordered(lambda numbered: work(*numbered, asked_to_stop), own, plan.workers)
        yield from progress.track(found, label, total=len(own))
    for module in held:
        module.requires_grad_(True)


def _fit_chunk(problem: Problem, plan: Plan, name: str, chunk: Chunk, steps: int, asked_to_stop: Callable[[], bool]) -> ChunkLoss:
    """Pose the template in one stretch of frames; nothing else changes. Returns what its poses lack."""
    loss = ChunkLoss(problem, chunk, plan.weights, plan.batches)
    fit(
        modules={"chunk": chunk},
        optimizer=torch.optim.AdamW(chunk.groups(plan.rates)),
        loss=lambda step, generator: loss(step / steps, generator),
        steps=steps,
        seed=_seed(plan.seed, name),
        resume=plan.resume / name if plan.resume else None,
        save_every=steps,
        schedule=cosine,
        label=name,
        asked_to_stop=asked_to_stop,
    )
    return loss


def field_groups(field: nn.Module, rates: Rates) -> list[dict]:
    """Return a field's parameters with their rates; grids learn fast, networks slowly, an encoding that is one too."""
    heads = [parameter for name, parameter in field.named_parameters() if not name.startswith("grid.levels.")]
    grid = [parameter for name, parameter in field.named_parameters() if name.startswith("grid.levels.")]
    return [
        {"params": grid, "lr": rates.grid, "weight_decay": 0.0, "betas": (0.9, 0.99)},
        {"params": heads, "lr": rates.heads, "weight_decay": 1e-4},
    ]


def _motion_group(parameters: list[nn.Parameter], rate: float, momentum: float = 0.0) -> dict:
    """By default without momentum: a frame that is not looked at must not move."""
    return {"params": parameters, "lr": rate, "weight_decay": 0.0, "betas": (momentum, 0.99)}


def joint_groups(problem: Problem, rates: Rates) -> list[dict]:
    """Return all that learns in the second phase, with its rates."""
    motion = problem.motion
    shares = ((problem.scene, 0.25), (problem.agent, rates.agent))
    groups = [{**group, "lr": group["lr"] * share} for field, share in shares for group in field_groups(field, rates)]
    groups += [_motion_group([motion.camera], rates.camera * 0.3, momentum=0.9), _motion_group([motion.root, motion.bone], rates.motion)]
    return [*groups, {"params": list(problem.body.parameters()), "lr": rates.skin, "weight_decay": 0.0}]


def _seed(seed: int, name: str) -> int:
    """Give each phase its own stream."""
    return int(np.random.SeedSequence([seed, *name.encode()]).generate_state(1)[0])
