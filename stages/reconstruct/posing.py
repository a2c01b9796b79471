"""Pose the template in consecutive frames: root, limbs and bones are optimized; field and skin are fixed.

A sitting animal raises its front, but registered roots are level and gradient descent hardly finds the lean.
Each segment of frames is posed briefly from every `Stance`; posing starts from the one with the lowest loss.
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
from stages.reconstruct.limbs import MultiscaleRotations
from stages.reconstruct.problem import Problem, RaysByFrame
from stages.reconstruct.rays import AGENT

KNOT_FRAMES = (32, 8)
"""spacings of the knots of limb rotations, besides the per-frame ones"""
ROOT_SHARE = 0.25
"""share of the steps in which the root moves alone"""
POSED_RAYS, POSED_POINTS = 96, 384
"""masked rays and surface points per frame and step"""
SLOW_RATE, FRAME_RATE = 2e-2, 1e-2
"""learning rates, meters and radians: of root and knots, and of per-frame bones and rotations"""
MOMENTUM = (0.8, 0.99)
"""Adam's betas, shorter than usual because steps are few"""
RAISED_RAD = math.radians(30)
"""initial pitch of a sitting animal; posing refines it"""
STANCE_FRAMES = 10
"""frames that share a stance"""
STANCE_COST = 0.03
"""loss by which a stance other than level must be better; measured on the built-in cat"""
CHANGE_COST = 0.03
"""cost of a change of stance"""
MAX_MISFIT = 1.25
"""maximum loss of a stance other than level, in medians of level poses: worse fits are no evidence"""


@dataclass(frozen=True)
class Stance:
    """An initial pose."""

    lean: Float[Tensor, "4 4"]
    """the root relative to a level one"""
    bone: Float[Tensor, "bone 6"]
    """twists of bones from rest"""


def candidate_stances(problem: Problem) -> tuple[Stance, ...]:
    """Return the level stance, then one with the front raised and the legs upright."""
    rest, points = problem.motion.agent_from_bone_rest, problem.surface.points
    with torch.no_grad():
        leg = limbs.legs(problem.tree, points, problem.body.weights(points))
    raised = torch.tensor([-RAISED_RAD, 0.0, 0.0], device=problem.device)
    moved = problem.tree.motion(-raised * leg[None, :, None])[0]
    bone = rigid.log((rigid_torch.inverse(rest) @ moved @ rest).double().cpu().numpy())
    lean = rigid_torch.make(rigid_torch.so3_exp(raised), torch.zeros(3, device=problem.device))
    level = Stance(torch.eye(4, device=problem.device), torch.zeros(len(rest), 6, device=problem.device))
    return level, Stance(lean, torch.from_numpy(bone).to(level.bone))


def decode_stances(loss: Float[np.ndarray, "part stance"], typical: float) -> Int[np.ndarray, "part"]:
    """Return the stances of consecutive parts by the Viterbi algorithm; level and constant ones cost less.

    Parts without the agent have a loss of NaN. ``typical`` is the median loss of level poses.
    """
    stances = np.arange(loss.shape[1])
    cost = np.nan_to_num(loss) + STANCE_COST * (stances > 0)
    cost[:, 1:][loss[:, 1:] > MAX_MISFIT * typical] = np.inf
    change = CHANGE_COST * (stances[:, None] != stances)
    return viterbi.viterbi_decode(cost, lambda _: change)


def by_frame(stance: Int[np.ndarray, "part"], frames: int) -> Int[Tensor, "frame"]:
    """Repeat the stances of parts for their frames."""
    return torch.from_numpy(stance).repeat_interleave(STANCE_FRAMES)[:frames]


class PosedSegment(nn.Module):
    """Pose parameters of a segment of frames: root, limb rotations, and per-bone twists.

    They are initialized from the motion table or a stance.
    """

    def __init__(self, problem: Problem, frame: Int[Tensor, "frame"], stance: Stance | None = None):
        super().__init__()
        self.frame, motion = frame, problem.motion
        self.initial = motion.initial_agent[frame] @ stance.lean if stance else motion.initial_agent[frame]
        self.root = nn.Parameter(motion.root.detach()[frame].clone())
        bone = stance.bone.repeat(len(frame), 1, 1) if stance else motion.bone.detach()[frame].clone()
        self.bone = nn.Parameter(bone)
        self.turn = MultiscaleRotations(len(frame), motion.bone.shape[1], KNOT_FRAMES).to(problem.device)

    def groups(self) -> list[dict]:
        """Return the optimizer's parameter groups."""
        shared = {"weight_decay": 0.0, "betas": MOMENTUM}
        slow, quick = [self.root, *self.turn.knots], [self.bone, self.turn.each]
        return [{"params": slow, "lr": SLOW_RATE, **shared}, {"params": quick, "lr": FRAME_RATE, **shared}]

    def pose(self, problem: Problem, bones_move: bool = True) -> tuple[Pose, Float[Tensor, "frame twist 6"]]:
        """Return the current poses and the twists of bones and limbs, which priors keep near zero."""
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


class SegmentLoss:
    """The loss of the poses of a segment of frames, with a ``share`` of the usual rays and points.

    Features are left out because their cells mix thin limbs with the background, cycles because the skin is
    fixed.
    """

    def __init__(self, problem: Problem, segment: PosedSegment, weights: LossWeights, share: float = 1.0):
        self.problem, self.segment = problem, segment
        self.rays, self.points = round(share * POSED_RAYS), round(share * POSED_POINTS)
        self.weights = replace(weights, feature=0.0, cycle=0.0)
        self.masked = torch.nonzero(problem.store.agent.label == AGENT)[:, 0]
        self.masked_rays = RaysByFrame.of(problem.store.agent.frame[self.masked], len(problem.video))
        has_rays = self.masked_rays.count[segment.frame] > 0
        self.seen = torch.isin(segment.frame, problem.agent_frames) & has_rays

    def __call__(self, progress: float, generator: Generator) -> dict[str, Tensor]:
        """Return the weighted terms over all frames of the chunk."""
        return self._terms(*self.segment.pose(self.problem, progress >= ROOT_SHARE), self.seen, generator)

    @torch.no_grad()
    def of_parts(self, length: int, generator: Generator) -> Float[Tensor, "part"]:
        """Return the loss of each ``length`` frames; NaN where the agent is not in view."""
        pose, twist = self.segment.pose(self.problem)
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
