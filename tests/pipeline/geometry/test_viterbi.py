"""Viterbi decoding equals exhaustive search, also for different numbers of states per step."""

import itertools

import numpy as np

from pipeline.geometry.viterbi import viterbi_decode


def test_decoded_path_has_minimal_cost():
    rng = np.random.default_rng(0)
    for states in ((1,), (2, 3, 1, 4), (3, 3, 3, 3, 3)):
        cost = [rng.random(count) for count in states]
        change = [None, *(rng.random(pair) for pair in itertools.pairwise(states))]

        def cost_of(way, cost=cost, change=change):
            return sum(each[state] for each, state in zip(cost, way, strict=True)) + sum(
                change[step][way[step - 1], way[step]] for step in range(1, len(way))
            )

        best = min(itertools.product(*map(range, states)), key=cost_of)
        assert viterbi_decode(cost, change.__getitem__).tolist() == list(best)
