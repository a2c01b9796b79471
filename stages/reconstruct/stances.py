"""Stances: an animal that sits raises its front. Registered roots are level, and gradient steps hardly find
the lean.

Each segment of frames is posed briefly from every stance, and posing starts from the one with the lowest
loss.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from pipeline.geometry import rigid, rigid_torch, viterbi
from stages.reconstruct import limbs
from stages.reconstruct.problem import Problem

RAISED_RAD = math.radians(30)
"""lean of an animal that sits; posing finds the rest"""
PART = 10
"""frames that share a stance"""
SURE = 0.03
"""a stance that is not level must lower the loss by so much; measured on the built-in cat"""
CHANGE = 0.03
"""and a change of stance by so much more"""
FITS = 1.25
"""and the loss must be at most so many times the median of level poses: the better of two misfits is no
evidence"""


@dataclass(frozen=True)
class Stance:
    """How posing may start."""

    lean: Float[Tensor, "4 4"]
    """the root relative to a level one"""
    bone: Float[Tensor, "bone 6"]
    """twists of bones from rest"""


def candidates(problem: Problem) -> tuple[Stance, ...]:
    """Return level first, then with the front raised over legs that stay upright (agent: x left, y up, z
    ahead).
    """
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
    """Return the stances of consecutive parts by the Viterbi algorithm: low losses, few changes, level if in
    doubt.

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
