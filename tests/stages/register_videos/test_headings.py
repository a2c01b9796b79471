"""Front and back are distinguished by walking, and the decision persists during occlusion, rest and turns."""

import numpy as np
import pytest

from pipeline.geometry import rigid
from stages.register_videos import headings
from stages.register_videos.headings import RootHypotheses

UP = np.array([0.0, 1.0, 0.0])
LENGTH_M = 0.6


def seen(
    frame: int,
    yaw_deg: float,
    place,
    advantage: float,
    *,
    share: float = 1.0,
    misfit: float = 5.0,
    eye=(2.0, 1, 0),
) -> RootHypotheses:
    """Return a front and a back hypothesis; the wrong one scores better by ``advantage``."""
    yaw, place = np.deg2rad([yaw_deg, yaw_deg + 180]), np.asarray(place, float)
    poses = rigid.make(rigid.rotation_from_vector(yaw[:, None] * UP), np.repeat(place[None], 2, axis=0))
    return RootHypotheses(
        frame, poses, np.array([advantage, 0.0]), misfit, share, place, np.asarray(eye, float)
    )


def chosen(sights: list[RootHypotheses]) -> list[int]:
    faced = headings.decode_headings(np.arange(len(sights)) * 0.1, sights, LENGTH_M)
    return headings.choose_hypotheses(sights, faced)


def test_walking_direction_determines_the_heading():
    assert chosen([seen(frame, 0.0, (0, 0, 0.06 * frame), 1.5) for frame in range(30)]) == [0] * 30


def test_reversed_template_is_detected():
    """The appearance clearly indicates in every frame that the animal walks along -z."""
    there_and_back = 3.0 - np.abs(np.arange(60) * 0.06 - 1.8)
    yaw = np.where(np.arange(60) < 30, 180.0, 0.0)
    sights = [seen(frame, yaw[frame], (0, 0, there_and_back[frame]), -3.0) for frame in range(60)]
    assert chosen(sights) == [0] * 60


def test_heading_persists_at_rest():
    z = np.minimum(np.arange(40), 15) * 0.06
    assert (
        chosen([seen(frame, 0.0, (0, 0, z[frame]), 1.0 if frame > 18 else -1.0) for frame in range(40)])
        == [0] * 40
    )


@pytest.mark.parametrize("spoilt", [{"share": 0.02}, {"misfit": 60.0}])
def test_occluded_and_badly_fitted_frames_do_not_flip_the_heading(spoilt):
    sights = [seen(frame, 0.0, (0, 0, 0), -2.0, eye=(2, 1, 0.1 * frame)) for frame in range(40)]
    for frame in range(15, 25):
        sights[frame] = seen(frame, 0.0, (0, 0, 0), 6.0, eye=(2, 1, 0.1 * frame), **spoilt)
    assert chosen(sights) == [0] * 40


def test_noise_does_not_flip_the_heading():
    rng = np.random.default_rng(0)
    yaw = 1.5 * np.arange(60) + rng.normal(0, 20, 60)
    sights = [
        seen(frame, yaw[frame], (0, 0, 0), rng.normal(-0.5, 1.5), eye=(2, 1, 0.1 * frame))
        for frame in range(60)
    ]
    assert chosen(sights) == [0] * 60
    faced = headings.decode_headings(np.arange(60) * 0.1, sights, LENGTH_M).likeliest_rad
    assert np.abs(np.rad2deg(rigid.wrap(faced - np.deg2rad(1.5 * np.arange(60))))).mean() < 15, (
        "degrees, of 20 in single frames"
    )


def test_turn_within_a_second_is_tracked():
    yaw = np.clip((np.arange(40) - 15) * 20.0, 0, 180)
    sights = [seen(frame, yaw[frame], (0, 0, 0), -2.0, eye=(2, 1, 0.1 * frame)) for frame in range(40)]
    assert chosen(sights) == [0] * 40


def test_headings_of_equal_evidence_are_as_likely_as_each_other():
    """Front and back of an animal at rest fit equally well, until a clear view."""
    for advantage, least, most in ((0.0, 0.3, 0.7), (-4.0, 0.95, 1.0)):
        sights = [seen(frame, 30.0, (0, 0, 0), advantage, eye=(2, 1, 0.1 * frame)) for frame in range(20)]
        faced = headings.decode_headings(np.arange(20) * 0.1, sights, LENGTH_M)
        np.testing.assert_allclose(faced.probability.sum(1), 1.0)
        likely = faced.probability_near(np.full(20, np.deg2rad(30.0)))
        assert (likely > least).all() and (likely <= most + 1e-9).all()
