"""Pose the template in consecutive frames: root, limbs and bones are optimized; field and skin are fixed."""

from dataclasses import replace

import torch
from jaxtyping import Float, Int
from torch import Generator, Tensor, nn
from torch.nn import functional

from pipeline.fields.limbs import MultiscaleRotations
from pipeline.geometry import rigid, rigid_torch
from stages.reconstruct import losses
from stages.reconstruct.body import Pose, measured_terms, prior_terms, surface_terms
from stages.reconstruct.config import LossWeights
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


class PosedSegment(nn.Module):
    """Pose parameters of a segment of frames, initialized from the motion table: root, limb rotations, and
    per-bone twists.
    """

    def __init__(self, problem: Problem, frame: Int[Tensor, "frame"]):
        super().__init__()
        self.frame, motion = frame, problem.motion
        self.initial = motion.initial_agent[frame]
        self.root = nn.Parameter(motion.root.detach()[frame].clone())
        self.bone = nn.Parameter(motion.bone.detach()[frame].clone())
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
    """The loss of the poses of a segment of frames.

    Features are left out because their cells mix thin limbs with the background, cycles because the skin is
    fixed.
    """

    def __init__(self, problem: Problem, segment: PosedSegment, weights: LossWeights):
        self.problem, self.segment = problem, segment
        self.weights = replace(weights, feature=0.0, cycle=0.0)
        self.masked = torch.nonzero(problem.store.agent.label == AGENT)[:, 0]
        self.masked_rays = RaysByFrame.of(problem.store.agent.frame[self.masked], len(problem.video))
        has_rays = self.masked_rays.count[segment.frame] > 0
        self.seen = torch.isin(segment.frame, problem.agent_frames) & has_rays

    def __call__(self, progress: float, generator: Generator) -> dict[str, Tensor]:
        """Return the weighted terms over all frames of the segment."""
        pose, twist = self.segment.pose(self.problem, progress >= ROOT_SHARE)
        problem, terms = self.problem, {}
        if self.seen.any():
            shown = pose.at(self.seen)
            picked = self.masked_rays.pick(shown.frame, POSED_RAYS, generator).flatten()
            rays = problem.store.agent.at(self.masked[picked])
            terms = measured_terms(problem, shown, rays, self.weights, generator, near=0)
            terms |= surface_terms(problem, shown, POSED_POINTS, self.weights, generator, rays)
        return losses.weighted(terms | prior_terms(problem, pose, twist, len(pose.frame), self.weights))
