"""The cheapest way through a sequence of states (Viterbi 1967)."""

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float, Int


def viterbi_decode(
    cost: Sequence[Float[np.ndarray, "_"]] | Float[np.ndarray, "step state"],
    change: Callable[[int], Float[np.ndarray, "_ _"]],
) -> Int[np.ndarray, "step"]:
    """Return the state of each step whose costs, those of changes included, are least in sum; of equal ones
    the first.

    Args:
        cost: of each state, at each step; steps may differ in their number of states.
        change: costs of all changes from the step before to the one of this index, from 1 on.
    """
    total, came = cost[0], []
    for index in range(1, len(cost)):
        reached = total[:, None] + change(index)
        came.append(reached.argmin(0))
        total = reached.min(0) + cost[index]
    found = [int(total.argmin())]
    for back in reversed(came):
        found.append(int(back[found[-1]]))
    return np.array(found[::-1])
