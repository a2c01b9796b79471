"""Roots that registration doubts are bridged where believed ones are near in time, and their masks hardly count."""

import dataclasses

import numpy as np
import torch

from pipeline.space import rigid
from stages.reconstruct import assemble
from stages.reconstruct.assemble import Doubt
from tests.stages.reconstruct.test_optimise import SHAPES, WIDE, film, problem


def doubted(confidence: np.ndarray, spacing_s: float = 0.5) -> assemble.Video:
    """Return a ball that moves 3 cm a frame along x; where it is doubted, it is registered 2 m too high and turned round."""
    video = film("v002", len(confidence), True, np.random.default_rng(0), WIDE)
    root = rigid.make(np.eye(3), np.arange(len(confidence))[:, None] * np.array([0.03, 0, 0]))
    wrong = rigid.exp(np.array([0, np.pi, 0, 0, 2.0, 0]))
    root[confidence < 0.4] = root[confidence < 0.4] @ wrong
    return dataclasses.replace(
        video, timestamp_s=np.arange(len(confidence)) * spacing_s, world_from_agent=root, agent_confidence=confidence
    )


def test_short_doubt_is_bridged_and_long_doubt_stays():
    confidence = np.ones(12)
    confidence[[3, 4, 11]] = 0.1
    root = assemble.believed_roots(doubted(confidence), Doubt(longest_gap_s=2.0))
    np.testing.assert_allclose(root[:11, 0, 3], 0.03 * np.arange(11), atol=1e-9)
    np.testing.assert_allclose(root[:11, 1, 3], 0, atol=1e-9)
    assert root[11, 1, 3] == 2.0, "nothing believed comes after: what is registered is all there is"
    confidence[2:9] = 0.1
    assert (assemble.believed_roots(doubted(confidence), Doubt(longest_gap_s=2.0))[2:9, 1, 3] == 2.0).all()
    unknown = doubted(np.zeros(4))
    unknown.world_from_agent[:] = np.nan
    assert np.isnan(assemble.believed_roots(unknown, Doubt())).all()


def test_doubted_frames_hardly_count_and_the_joint_phase_leaves_them_out():
    confidence = np.ones(12)
    confidence[5] = 0.2
    _, videos = problem()
    built, _ = problem(videos=[doubted(confidence), videos[1]])
    assert built.trust[5] == SHAPES.doubt.trust and built.trust.sum() == len(built.trust) - 1 + SHAPES.doubt.trust
    runs = built.runs(3)
    assert torch.isin(torch.tensor([0, 2, 6]), runs).all() and not torch.isin(torch.tensor([3, 4, 5]), runs).any()
