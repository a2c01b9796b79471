"""Run the phases in order: copy the agent template, fit the scene, pose the template, fit everything.

Each phase is one call of `pipeline.core.training.fit` with its own checkpoints, so that a killed run resumes.
"""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Int
from torch import Tensor, nn

from pipeline.core import distributed, progress, threads
from pipeline.core.training import FitRecord, fit, termination
from stages.reconstruct.config import LearningRates, LossWeights, PhaseSteps, RayBatches
from stages.reconstruct.former import KnownMotion
from stages.reconstruct.joint import JointLoss, TemplateLoss
from stages.reconstruct.posing import PosedSegment, SegmentLoss
from stages.reconstruct.problem import Problem
from stages.reconstruct.scene import SceneLoss

BETA1, BETA2 = 0.9, 0.99
"""Adam's betas: of the gradient, where a parameter learns in every step, and of its square"""
HEAD_DECAY = 1e-4
"""weight decay of networks; grids and poses have none"""
SEGMENT_FRAMES = 100
"""frames that are posed together"""
LAST_RATE = 0.05
"""learning rates fall to this share"""
CLIP_NORM = 10.0
"""largest norm of the gradient"""
MOTION_RATE, SKIN_RATE = 5e-4, 2e-3
"""learning rates of the second phase: of root and bones, meters and radians, and of the skin"""
JOINT_SCENE, JOINT_AGENT, JOINT_CAMERA = 0.25, 0.2, 0.3
"""shares of the first phase's learning rates in the second: fields and cameras are nearly right"""


@dataclass(frozen=True)
class OptimizationPlan:
    """Settings of the optimization."""

    steps: PhaseSteps
    weights: LossWeights
    batches: RayBatches
    rates: LearningRates
    seed: int
    resume: Path | None
    """folder for checkpoints"""
    workers: int = 1
    """segments that are posed at once, each by one thread"""
    known: KnownMotion | None = None
    """known motion of the agent after a warm start; its frames are not posed again"""
    rendered: bool = False
    """losses of scene and agent by differentiable rendering alone (`Config.supervision`)"""


def cosine(progress: float) -> float:
    """Return the factor on learning rates: from 1 to a twentieth along a cosine."""
    return LAST_RATE + (1 - LAST_RATE) * 0.5 * (1 + math.cos(math.pi * progress))


@threads.single_threaded()
def optimize(problem: Problem, plan: OptimizationPlan) -> dict[str, FitRecord]:
    """Run all phases; the modules of the problem change in place. Returns the losses of each phase.

    Several processes (`pipeline.core.distributed`) share the videos: each takes rays of its own videos and
    poses the template in them.
    """
    steps, rates, everything = plan.steps, plan.rates, problem
    if distributed.size() > 1:
        problem = problem.share(distributed.rank(), distributed.size())
        plan = replace(plan, batches=plan.batches.share(distributed.size()))
    records, agent = {}, field_groups(problem.agent, rates)
    records["template"] = _run(problem, plan, "template", TemplateLoss(problem), steps.template, agent)
    cameras = _motion_group([problem.motion.camera], rates.camera, momentum=BETA1)
    scene = [*field_groups(problem.scene, rates), cameras]
    annealed = steps.scene + (steps.joint if len(everything.agent_frames) else 0)
    loss = SceneLoss(problem, plan.weights, plan.batches, annealed, plan.rendered)
    records["scene"] = _run(problem, plan, "scene", loss, steps.scene, scene)
    if len(everything.agent_frames):
        segments = list(split_segments(everything, SEGMENT_FRAMES))
        if plan.known:
            known = plan.known.frame.to(problem.device)
            segments = [frame for frame in segments if not torch.isin(frame, known).any()]
        if steps.body:
            _pose(problem, plan, segments)
        for corrections in (problem.motion.root, problem.motion.bone):
            corrections.data.copy_(distributed.total(corrections))
        if plan.known:
            plan.known.write(problem)
        loss = JointLoss(problem, plan.weights, plan.batches, annealed, plan.rendered, steps.scene)
        records["joint"] = _run(problem, plan, "joint", loss, steps.joint, joint_groups(problem, rates))
    return records


def split_segments(problem: Problem, length: int) -> Iterable[Int[Tensor, "frame"]]:
    """Cut each stretch's frames into segments of up to ``length`` that hold at least one usable frame."""
    for stretch in range(int(problem.stretch.max()) + 1):
        frames = torch.nonzero(problem.stretch == stretch)[:, 0]
        for part in frames.split(length):
            if torch.isin(part, problem.agent_frames).any():
                yield part


def _run(
    problem: Problem, plan: OptimizationPlan, name: str, loss, steps: int, groups: list[dict]
) -> FitRecord:
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
        clip_norm=CLIP_NORM,
        shared=True,
    )


def _pose(problem: Problem, plan: OptimizationPlan, segments: Sequence[torch.Tensor]) -> None:
    """Pose the template in all segments with usable frames; write roots and bones into the motion table.

    Fields and body are frozen.
    """
    held = nn.ModuleList([problem.agent, problem.body, problem.scene]).requires_grad_(False)
    numbered, steps = enumerate(segments), plan.steps.body
    own = [(index, frame) for index, frame in numbered if torch.isin(frame, problem.agent_frames).any()]

    def pose(segment: tuple[int, torch.Tensor]) -> PosedSegment:
        name, posed = f"body_{segment[0]:04d}", PosedSegment(problem, segment[1])
        loss = SegmentLoss(problem, posed, plan.weights)
        fit(
            modules={"segment": posed},
            optimizer=torch.optim.AdamW(posed.groups()),
            loss=lambda step, generator: loss(step / steps, generator),
            steps=steps,
            seed=_seed(plan.seed, name),
            resume=plan.resume / name if plan.resume else None,
            save_every=steps,
            schedule=cosine,
            label=name,
            asked_to_stop=asked_to_stop,
        )
        return posed

    with termination() as asked_to_stop:
        results = threads.ordered(pose, own, plan.workers)
        for posed in progress.track(results, "posing", total=len(own)):
            posed.write(problem)
    held.requires_grad_(True)


def field_groups(field: nn.Module, rates: LearningRates) -> list[dict]:
    """Return a field's parameter groups: grids have a high learning rate, networks a low one."""
    heads, grid = (
        [value for name, value in field.named_parameters() if name.startswith("grid.levels.") == is_grid]
        for is_grid in (False, True)
    )
    return [
        {"params": grid, "lr": rates.grid, "weight_decay": 0.0, "betas": (BETA1, BETA2)},
        {"params": heads, "lr": rates.heads, "weight_decay": HEAD_DECAY},
    ]


def _motion_group(parameters: list[nn.Parameter], rate: float, momentum: float = 0.0) -> dict:
    """Return a parameter group; no momentum by default, so that frames outside the batch do not move."""
    return {"params": parameters, "lr": rate, "weight_decay": 0.0, "betas": (momentum, BETA2)}


def joint_groups(problem: Problem, rates: LearningRates) -> list[dict]:
    """Return the parameter groups of the second phase."""
    motion = problem.motion
    groups = []
    for field, share in ((problem.scene, JOINT_SCENE), (problem.agent, JOINT_AGENT)):
        groups += [{**group, "lr": group["lr"] * share} for group in field_groups(field, rates)]
    return [
        *groups,
        _motion_group([motion.camera], rates.camera * JOINT_CAMERA, momentum=BETA1),
        _motion_group([motion.root, motion.bone], MOTION_RATE),
        {"params": list(problem.body.parameters()), "lr": SKIN_RATE, "weight_decay": 0.0},
    ]


def _seed(seed: int, name: str) -> int:
    """Return the seed of one phase."""
    return int(np.random.SeedSequence([seed, *name.encode()]).generate_state(1)[0])
