"""Pose the template in consecutive frames: root, limbs and bones move, field and skin are fixed.

An animal that sits raises its front. Registered roots are level, and gradients hardly find the lean: each
segment of frames is posed briefly from every `Stance`, and posing starts from the one with the lowest loss.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Generator, Tensor, nn
from torch.nn import functional

from pipeline.geometry import rigid, rigid_torch, viterbi
from stages.reconstruct import limbs, losses
from stages.reconstruct.body import Pose, measured_terms, prior_terms, surface_terms
from stages.reconstruct.config import LossWeights
from stages.reconstruct.limbs import MultiscaleTurns
from stages.reconstruct.problem import Problem, RaysByFrame
from stages.reconstruct.rays import AGENT

KNOT_FRAMES = (32, 8)
"""distances of the knots of limbs' rotations, which also change frame by frame"""
ROOT_SHARE = 0.25
"""share of the steps in which the root moves alone"""
POSED_RAYS, POSED_POINTS = 96, 384
"""masked rays and surface points per frame and step"""
SLOW_RATE, FRAME_RATE = 2e-2, 1e-2
"""learning rates, metres and radians: of the root and limbs' slow rotations, and of what changes by frame"""
MOMENTUM = (0.8, 0.99)
"""Adam's, shorter than usual for few steps"""
RAISED_RAD = math.radians(30)
"""lean of an animal that sits; posing finds the rest"""
PART = 10
"""frames that share a stance"""
SURE = 0.03
"""a stance that is not level must lower the loss by so much; measured on the built-in cat"""
CHANGE = 0.03
"""and a change of stance by so much more"""
FITS = 1.25
"""and the loss must be at most so many times the median of level poses: a better misfit is no evidence"""


@dataclass(frozen=True)
class Stance:
    """How posing may start."""

    lean: Float[Tensor, "4 4"]
    """the root relative to a level one"""
    bone: Float[Tensor, "bone 6"]
    """twists of bones from rest"""


def candidates(problem: Problem) -> tuple[Stance, ...]:
    """Return level first, then with the front raised over legs that stay upright."""
    rest, points = problem.motion.agent_from_bone_rest, problem.surface.points
    with torch.no_grad():
        leg = limbs.legs(problem.tree, points, problem.body.weights(points))
    raised = torch.tensor([-RAISED_RAD, 0.0, 0.0], device=problem.device)
    carried = problem.tree.motion(-raised * leg[None, :, None])[0]
    bone = rigid.log((rigid_torch.inverse(rest) @ carried @ rest).double().cpu().numpy())
    lean = rigid_torch.make(rigid_torch.so3_exp(raised), torch.zeros(3, device=problem.device))
    level = Stance(torch.eye(4, device=problem.device), torch.zeros(len(rest), 6, device=problem.device))
    return level, Stance(lean, torch.from_numpy(bone).to(level.bone))


def most_likely(loss: Float[np.ndarray, "part stance"], usual: float) -> Int[np.ndarray, "part"]:
    """Return the stances of consecutive parts by the Viterbi algorithm: low losses, few changes, level first.

    Parts without the agent have a loss of NaN. ``usual`` is the median loss of level poses.
    """
    stances = np.arange(loss.shape[1])
    cost = np.nan_to_num(loss) + SURE * (stances > 0)
    cost[:, 1:][loss[:, 1:] > FITS * usual] = np.inf
    change = CHANGE * (stances[:, None] != stances)
    return viterbi.viterbi_decode(cost, lambda _: change)


def by_frame(stance: Int[np.ndarray, "part"], frames: int) -> Int[Tensor, "frame"]:
    """Repeat the stances of parts for their frames."""
    return torch.from_numpy(stance).repeat_interleave(PART)[:frames]


class Chunk(nn.Module):
    """What moves in a segment of frames: the root, the limbs' rotations, and each bone by itself.

    They start as the motion table has them, or from a stance.
    """

    def __init__(self, problem: Problem, frame: Int[Tensor, "frame"], stance: Stance | None = None):
        super().__init__()
        self.frame, motion = frame, problem.motion
        self.initial = motion.initial_agent[frame] @ stance.lean if stance else motion.initial_agent[frame]
        self.root = nn.Parameter(motion.root.detach()[frame].clone())
        bone = stance.bone.repeat(len(frame), 1, 1) if stance else motion.bone.detach()[frame].clone()
        self.bone = nn.Parameter(bone)
        self.turn = MultiscaleTurns(len(frame), motion.bone.shape[1], KNOT_FRAMES).to(problem.device)

    def groups(self) -> list[dict]:
        """Return the optimizer's parameter groups."""
        shared = {"weight_decay": 0.0, "betas": MOMENTUM}
        slow, quick = [self.root, *self.turn.knots], [self.bone, self.turn.each]
        return [{"params": slow, "lr": SLOW_RATE, **shared}, {"params": quick, "lr": FRAME_RATE, **shared}]

    def pose(self, problem: Problem, bones_move: bool = True) -> tuple[Pose, Float[Tensor, "frame twist 6"]]:
        """Return the current poses, and the twists that priors keep near rest: of bones and of limbs."""
        motion, turn, bone = problem.motion, self.turn(), self.bone
        if not bones_move:
            turn, bone = turn.detach(), bone.detach()
        with torch.no_grad():
            world_from_camera = motion.world_from_camera(self.frame)
        root = self.initial @ rigid_torch.se3_exp(self.root)
        bones = problem.tree.motion(turn) @ motion.agent_from_bone_rest @ rigid_torch.se3_exp(bone)
        twists = torch.cat([bone, functional.pad(turn, (0, 3))], dim=1)
        return Pose(self.frame, world_from_camera, root, bones, self.initial), twists

    @torch.no_grad()
    def write(self, problem: Problem) -> None:
        """Write root and bones into the motion table."""
        pose, _ = self.pose(problem)
        bone = rigid_torch.inverse(problem.motion.agent_from_bone_rest) @ pose.agent_from_bone
        twists = torch.from_numpy(rigid.log(bone.double().cpu().numpy()))
        problem.motion.root[self.frame] = self.root
        problem.motion.bone[self.frame] = twists.to(self.bone)


class ChunkLoss:
    """The loss of the poses of a segment of frames, with a ``share`` of the usual rays and points.

    Features do not help here, whose cells mix thin limbs with the background, nor do cycles, since the skin
    is fixed.
    """

    def __init__(self, problem: Problem, chunk: Chunk, weights: LossWeights, share: float = 1.0):
        self.problem, self.chunk = problem, chunk
        self.rays, self.points = round(share * POSED_RAYS), round(share * POSED_POINTS)
        self.weights = replace(weights, feature=0.0, cycle=0.0)
        self.masked = torch.nonzero(problem.store.agent.label == AGENT)[:, 0]
        self.masked_rays = RaysByFrame.of(problem.store.agent.frame[self.masked], len(problem.video))
        self.seen = torch.isin(chunk.frame, problem.agent_frames) & (self.masked_rays.count[chunk.frame] > 0)

    def __call__(self, progress: float, generator: Generator) -> dict[str, Tensor]:
        """Return the weighted terms over all frames of the chunk."""
        return self._terms(*self.chunk.pose(self.problem, progress >= ROOT_SHARE), self.seen, generator)

    @torch.no_grad()
    def of_parts(self, length: int, generator: Generator) -> Float[Tensor, "part"]:
        """Return the loss of each ``length`` frames; NaN where the agent is not in view."""
        pose, twist = self.chunk.pose(self.problem)
        parts = [slice(first, first + length) for first in range(0, len(pose.frame), length)]
        terms = [self._terms(pose.at(part), twist[part], self.seen[part], generator) for part in parts]
        seen = torch.stack([self.seen[part].any() for part in parts])
        totals = [sum(each.values(), start=torch.zeros(())) for each in terms]
        return torch.stack(totals).where(seen, torch.nan)

    def _terms(self, pose: Pose, twist, seen, generator: Generator) -> dict[str, Tensor]:
        problem, terms = self.problem, {}
        if seen.any():
            shown = pose.at(seen)
            picked = self.masked_rays.pick(shown.frame, self.rays, generator).flatten()
            rays = problem.store.agent.at(self.masked[picked])
            terms = measured_terms(problem, shown, rays, self.weights, generator, near=0)
            terms |= surface_terms(problem, shown, self.points, self.weights, generator, rays)
        return losses.weighted(terms | prior_terms(problem, pose, twist, len(pose.frame), self.weights))
