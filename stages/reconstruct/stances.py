"""Stances: an animal that sits raises its front, which registered roots, all but level, do not tell, and small steps hardly find.

So each stretch of frames is posed briefly from every stance, and posing starts from the one whose losses are lowest.
"""

import math

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from pipeline.space import rigid_torch

RAISED_RAD = math.radians(30)
EVERY = 2
"""of so many frames one is looked at ..."""
PART = 5
"""... and a stance lasts for so many of these"""
SURE = 0.03
"""so much lower must the losses of a stance be that is not level"""
CHANGE = 0.03
"""and so much lower to be worth a change"""


def leans() -> Float[Tensor, "stance 4 4"]:
    """Return how the root of each stance stands in that of level ones (x left, y up, z ahead): level first, then with the front raised."""
    turn = torch.tensor([[0.0, 0.0, 0.0], [-RAISED_RAD, 0.0, 0.0]])
    return rigid_torch.make(rigid_torch.so3_exp(turn), torch.zeros(len(turn), 3))


def likeliest(loss: Float[np.ndarray, "part stance"]) -> Int[np.ndarray, "part"]:
    """Return the stances of consecutive parts (Viterbi): those of low losses that seldom change, level if in doubt."""
    stances = np.arange(loss.shape[1])
    cost = loss + SURE * (stances > 0)
    change = CHANGE * (stances[:, None] != stances)
    total, came = cost[0], []
    for each in cost[1:]:
        reached = total[:, None] + change
        came.append(reached.argmin(0))
        total = reached.min(0) + each
    found = [int(total.argmin())]
    for back in reversed(came):
        found.append(int(back[found[-1]]))
    return np.array(found[::-1])


def by_frame(stance: Int[np.ndarray, "part"], frames: int) -> Int[Tensor, "frame"]:
    """Repeat the stances of parts for the frames of the stretch that they were told of."""
    return torch.from_numpy(stance).repeat_interleave(EVERY * PART)[:frames]
