"""Chained simulation: a breathing animal counts as resting, despite millimeters of difference to recorded
motion.
"""

from dataclasses import replace

import numpy as np
import pytest

from pipeline.baselines.predictors import Ats
from pipeline.behavior.config import PlanSamplingConfig
from pipeline.behavior.planning import PlanCondition, SampledPlan
from pipeline.behavior.scenes import Scenes
from pipeline.behavior.trajectories import FUTURE, PAST, RATE_HZ, as_companions
from stages.tabulate_behavior import chaining
from tests.pipeline.behavior.wandering import REST, room, scaling, wandering


class Breathing:
    """A sampler whose animal stays where it is and breathes."""

    corrections, scaling = True, scaling()

    def avoids_solid(self, sampling):
        return True

    def codes(self, observation, sampling, count=1):
        rows = count * len(observation)
        return PlanCondition(np.zeros((rows, 1)), (), np.zeros((rows, 3)), sampling, None, count)

    def goals(self, codes, rng):
        return np.zeros((len(codes.full), 3))

    def paths(self, codes, goal, rng):
        return np.tile(0.002 * np.sin(np.arange(FUTURE))[:, None] * [0, 1, 0], (len(goal), 1, 1))

    def draw_plans(self, codes, rng, goal, path):
        upright = np.concatenate([[1, 0, 0, 0, 1, 0], np.zeros(6 * len(REST))])
        return SampledPlan(goal, path, np.tile(upright, (len(path), FUTURE, 1)))


def test_breathing_counts_as_rest():
    data, scenes = wandering(), Scenes.of(room())
    ats = Ats(Breathing(), scenes, REST, "yaw", PlanSamplingConfig())
    found = chaining.figures(ats, data, scenes, count=2, seconds=2.0, seed=0)
    tested = data.trajectories[data.videos[-1]]
    speed = np.linalg.norm(np.diff(tested.world_from_agent[:, :3, 3], axis=0), axis=-1) * RATE_HZ
    assert found["behavior/ats/chain_rest_share"] == 1 and found["behavior/ats/chain_solid_share"] == 0
    assert found["behavior/ats/chain_tilted_share"] == 0, "upright all the time"
    assert found["behavior/true/chain_rest_share"] == pytest.approx((speed < chaining.REST_SPEED_M_S).mean())
    assert found["behavior/ats/chain_moving_speed_ks"] == pytest.approx(
        (speed > chaining.REST_SPEED_M_S).mean()
    )
    assert found["behavior/ats/chain_moving_speed_ks"] <= found["behavior/ats/chain_speed_ks"]


def test_recorded_companions_are_perceived_all_along(monkeypatch):
    data, scenes = wandering(), Scenes.of(room())
    tested = data.videos[-1]
    recorded = data.trajectories[tested]
    friend = recorded.world_from_agent[:, None, :3, 3] + [0.5, 0, 0]
    data.trajectories[tested] = replace(recorded, companions=as_companions(friend))
    perceived = []

    class Watching(Breathing):
        def codes(self, observation, sampling, count=1):
            perceived.append(observation.others.shape[1])
            return super().codes(observation, sampling, count)

    stepped = []
    step = chaining.AnimalBatch.step

    def watched(animals, observer, companions=None):
        stepped.append((observer, companions))
        return step(animals, observer, companions)

    monkeypatch.setattr(chaining.AnimalBatch, "step", watched)
    ats = Ats(Watching(), scenes, REST, "yaw", PlanSamplingConfig())
    window = data.indices(1)[-1:]
    chaining.rollouts(ats, data, scenes, window, 6.0, np.random.default_rng(0))
    assert set(perceived) == {2}, "the observer and the friend"
    first = int(data.start[window][0]) + PAST
    frames = (first + np.arange(60)) % len(friend)
    assert frames[-1] < first, "beyond the recording's end, it begins again"
    person = recorded.world_from_camera[:, :3, 3]
    np.testing.assert_array_equal([observer[0] for observer, _ in stepped], person[frames])
    np.testing.assert_array_equal([others[0, 0, -1, :3] for _, others in stepped], friend[frames, 0])
