"""Stances: an animal that sits raises its front, which registered roots, all but level, do not tell, and small steps hardly find.

So each stretch of frames is posed briefly from every stance, and posing starts from the one whose losses are lowest.
"""

import math
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from pipeline import viterbi
from pipeline.space import rigid, rigid_torch
from stages.reconstruct import limbs
from stages.reconstruct.problem import Problem

RAISED_RAD = math.radians(30)
PART = 10
"""frames that share a stance"""
SURE = 0.03
"""so much lower must the losses of a stance be that is not level"""
CHANGE = 0.03
"""and so much lower to be worth a change"""
FITS = 1.25
"""and at most so many times the usual: where nothing fits, as with a wrong heading, the better of two misfits tells nothing"""


@dataclass(frozen=True)
class Stance:
    """How posing may start."""

    lean: Float[Tensor, "4 4"]
    """the root in that of who stands level"""
    bone: Float[Tensor, "bone 6"]
    """twists of bones from rest"""


def known(problem: Problem) -> tuple[Stance, ...]:
    """Return level first, then with the front raised over legs that stay upright (agent: x left, y up, z ahead)."""
    rest, points = problem.motion.agent_from_bone_rest, problem.surface.points
    with torch.no_grad():
        leg = limbs.legs(problem.limbs, points, problem.body.weights(points))
    raised = torch.tensor([-RAISED_RAD, 0.0, 0.0], device=problem.device)
    carried = problem.limbs.motion(-raised * leg[None, :, None])[0]
    bone = rigid.log((rigid_torch.inverse(rest) @ carried @ rest).double().cpu().numpy())
    lean = rigid_torch.make(rigid_torch.so3_exp(raised), torch.zeros(3, device=problem.device))
    level = Stance(torch.eye(4, device=problem.device), torch.zeros(len(rest), 6, device=problem.device))
    return level, Stance(lean, torch.from_numpy(bone).to(level.bone))


def likeliest(loss: Float[np.ndarray, "part stance"], usual: float) -> Int[np.ndarray, "part"]:
    """Return the stances of consecutive parts (Viterbi): those of low losses that seldom change, level if in doubt.

    Of parts without the agent nothing is known (NaN). The ``usual`` loss is that of level ones.
    """
    stances = np.arange(loss.shape[1])
    cost = np.nan_to_num(loss) + SURE * (stances > 0)
    cost[:, 1:][loss[:, 1:] > FITS * usual] = np.inf
    change = CHANGE * (stances[:, None] != stances)
    return viterbi.cheapest(cost, lambda _: change)


def by_frame(stance: Int[np.ndarray, "part"], frames: int) -> Int[Tensor, "frame"]:
    """Repeat the stances of parts for the frames of the stretch that they were told of."""
    return torch.from_numpy(stance).repeat_interleave(PART)[:frames]
