"""Chained simulation: a breathing animal counts as resting, despite millimeters of difference to recorded
motion.
"""

import numpy as np
import pytest

from pipeline.baselines.predictors import Ats
from pipeline.behavior.config import PlanSamplingConfig
from pipeline.behavior.planning import PlanCondition, SampledPlan
from pipeline.behavior.scenes import Scenes
from pipeline.behavior.trajectories import FUTURE, RATE_HZ
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
