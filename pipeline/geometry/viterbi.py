"""Minimum-cost state sequences (Viterbi 1967), and how likely each state is (forward-backward algorithm)."""

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


def marginals(
    cost: Float[np.ndarray, "step state"], change: Callable[[int], Float[np.ndarray, "state state"]]
) -> Float[np.ndarray, "step state"]:
    """Return the probability of each state at each step; costs as of `viterbi_decode`, negative log odds."""
    forward, backward = -np.array(cost, float), np.zeros(np.shape(cost))
    for index in range(1, len(cost)):
        forward[index] += np.logaddexp.reduce(forward[index - 1][:, None] - change(index), axis=0)
    for index in range(len(cost) - 2, -1, -1):
        after = backward[index + 1] - cost[index + 1]
        backward[index] = np.logaddexp.reduce(after - change(index + 1), axis=1)
    total = forward + backward
    return np.exp(total - np.logaddexp.reduce(total, axis=1, keepdims=True))
