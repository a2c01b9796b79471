"""Sitting is distinguished from standing per frame, although registered roots are level."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from stages.reconstruct import assemble, optimize, posing
from tests.stages.reconstruct.test_optimize import SHAPES, film_animal, plan, problem, template

FRAMES, SITS = 40, slice(20, 40)
HALF_M = np.array([0.1, 0.1, 0.3])
"""half axes of the animal, an ellipsoid"""


def test_stances_require_confidence_and_duration():
    level, raised = np.full(6, 0.2), np.full(6, 0.2)
    raised[[1, 3, 4]] -= [0.05, 0.08, 0.08]
    assert posing.decode_stances(np.stack([level, raised], -1), 0.2).tolist() == [0, 0, 0, 1, 1, 0]
    assert posing.decode_stances(np.stack([level, level - posing.STANCE_COST], -1), 0.2).tolist() == [0] * 6


def test_two_bad_fits_are_inconclusive():
    loss = np.tile([0.8, 0.5], (6, 1))
    assert posing.decode_stances(loss, 0.39).tolist() == [0] * 6
    assert posing.decode_stances(loss, 0.5).tolist() == [1] * 6
    loss[2] = np.nan
    assert posing.decode_stances(loss, 0.5).tolist() == [1] * 6, "unseen, it is thought to sit on"


def test_process_without_new_videos_chooses_none():
    found, _ = problem()
    without = replace(found, agent_frames=found.agent_frames[:0])
    before = found.motion.initial_agent.clone()
    optimize._choose_stances(without, plan(stance=1), list(optimize.split_segments(found, 100)))
    assert torch.equal(found.motion.initial_agent, before)


def test_stances_are_per_frame():
    found = posing.by_frame(np.array([0, 1, 0]), 25)
    assert found.tolist() == [0] * 10 + [1] * 10 + [0] * 5


@pytest.mark.slow
def test_sitting_is_detected():
    """The front rises by half its length, 30 degrees; registered roots are level."""
    level = np.tile(np.eye(4), (FRAMES, 1, 1))
    root = level.copy()
    root[SITS, :3, 1:3] = [[0, 0], [0.75**0.5, 0.5], [-0.5, 0.75**0.5]]
    video = film_animal("v002", root, level, HALF_M, True, np.random.default_rng(0))
    found = assemble.build([video], template(HALF_M), SHAPES, 0, "cpu")
    optimize.optimize(found, plan(template=100, scene=2, stance=20, body=2, joint=1))
    raised = found.motion.initial_agent[:, 1, 2]
    assert torch.allclose(raised[SITS], torch.tensor(0.5)) and torch.equal(
        raised[: SITS.start], torch.zeros(SITS.start)
    )
