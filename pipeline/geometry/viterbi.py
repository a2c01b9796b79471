"""Minimum-cost state sequences (Viterbi 1967)."""

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float, Int


def viterbi_decode(
    cost: Sequence[Float[np.ndarray, "_"]] | Float[np.ndarray, "step state"],
    change: Callable[[int], Float[np.ndarray, "_ _"]],
) -> Int[np.ndarray, "step"]:
    """Return the state sequence with the least sum of state and transition costs; ties go to the first state.

    Args:
        cost: of each state at each step; the number of states may differ between steps.
        change: transition costs from the previous step to the step of this index, from 1 on.
    """
    total, pointers = cost[0], []
    for index in range(1, len(cost)):
        reached = total[:, None] + change(index)
        pointers.append(reached.argmin(0))
        total = reached.min(0) + cost[index]
    path = [int(total.argmin())]
    for pointer in reversed(pointers):
        path.append(int(pointer[path[-1]]))
    return np.array(path[::-1])
