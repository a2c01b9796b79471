"""The cheapest way is the one that trying all ways finds, also where steps differ in their states."""

import itertools

import numpy as np

from pipeline.geometry.viterbi import viterbi_decode


def test_no_way_is_cheaper():
    rng = np.random.default_rng(0)
    for states in ((1,), (2, 3, 1, 4), (3, 3, 3, 3, 3)):
        cost = [rng.random(count) for count in states]
        change = [None, *(rng.random(pair) for pair in itertools.pairwise(states))]

        def price(way, cost=cost, change=change):
            return sum(each[state] for each, state in zip(cost, way, strict=True)) + sum(
                change[step][way[step - 1], way[step]] for step in range(1, len(way))
            )

        best = min(itertools.product(*map(range, states)), key=price)
        assert viterbi_decode(cost, change.__getitem__).tolist() == list(best)
