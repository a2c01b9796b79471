"""Depth noise, presence of the animal, robustness to holes and moved objects, and detection of implausible
masks.
"""

from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from pipeline.geometry import rigid
from pipeline.segmentation.grabcut import SURE
from stages.segment_agent import free_space, masks, movers, refine, segmenter, writing
from stages.segment_agent.config import AnimalConfig, Config, LearningConfig
from stages.segment_agent.evidence import Evidence
from stages.segment_agent.free_space import DepthNoise, References
from stages.segment_agent.movers import Candidate
from stages.segment_agent.refine import Edges
from stages.segment_agent.segmenter import Segmenter
from stages.segment_agent.windows import Sphere, Window
from stages.segment_agent.writing import Summary

INTRINSICS = np.array([[80.0, 0, 50], [0, 80.0, 40], [0, 0, 1]])


def slanted_wall(count, noise, rng):
    """Return pictures of a wall between 1 m and 4 m by a static camera, with noise proportional to z squared."""
    z = np.broadcast_to(np.linspace(1.0, 4.0, 100), (80, 100))
    return (z + noise.sigma_m(z) * rng.normal(size=(count, 80, 100))).astype(np.float32)


def test_depth_noise_is_measured_by_range():
    true, rng = DepthNoise(0.004, 0.003), np.random.default_rng(0)
    depth = slanted_wall(12, true, rng)
    found = free_space.measure_noise(depth, np.tile(np.eye(4), (12, 1, 1)), np.tile(INTRINSICS, (12, 1, 1)))
    twice = np.sqrt(2)  # both pictures have noise
    for z in (1.5, 3.5):
        assert found.sigma_m(np.array(z)) == pytest.approx(twice * true.sigma_m(np.array(z)), rel=0.15)


def references_of(depth):
    count = len(depth)
    pose, k = np.tile(rigid.inverse(np.eye(4)), (count, 1, 1)), np.tile(INTRINSICS, (count, 1, 1))
    color, nearest = np.zeros((*depth.shape, 3), np.uint8), free_space._min_filter(depth, k)
    return References(pose, k, depth, nearest, color, np.arange(count), DepthNoise())


def test_space_around_depth_holes_is_not_free():
    """A thin leg at 1.5 m, missing in half of the depth pictures, in front of a wall at 3 m."""
    depth = np.full((10, 80, 100), 3.0, np.float32)
    depth[::2, :, 50] = 1.5
    depth[1::2, :, 50] = 0.0
    point = np.array([[[0.5 / 80 * 1.5, 0.0, 1.5]]])
    votes = free_space.vote(references_of(depth), point, frame=-1)
    assert votes.free.item() == 0
    moving = np.full((10, 80, 100), 3.0, np.float32)
    assert free_space.vote(references_of(moving), point, frame=-1).free.item() == 10


def test_moved_objects_are_no_animal():
    """An object that stays for 2 s where it was put, one that walks, and one that flashes."""
    thing = [Candidate(np.array([1.0, 0.0, 0.0]), 0.05, 0.2)] * 20
    animal = [Candidate(np.array([0.05 * i, 0.0, 2.0]), 0.05, 0.2) for i in range(20)]
    flashes = [Candidate(np.array([3.0 * (i % 2), 0.0, 0.0]), 0.05, 0.2) for i in range(6)]
    chosen = [*thing, *[None] * 10, *animal, *[None] * 10, *flashes]
    time_s = 0.1 * np.arange(len(chosen))
    assert np.flatnonzero(movers.self_moving(chosen, time_s, AnimalConfig())).tolist() == list(range(30, 50))


def test_tracks_that_never_move_must_be_within_reach():
    """The animal walks, leaves, and rests nearby; meanwhile a shelf that looks like it is tracked."""
    animal = [Candidate(np.array([0.05 * i, 0.0, 2.0]), 0.05, 0.2) for i in range(20)]
    rests = [Candidate(np.array([1.5, 0.0, 2.0]), 0.05, 0.2, moving=0.0)] * 10
    shelf = [Candidate(np.array([9.0, 1.0, 2.0]), 0.05, 0.2, moving=0.0)] * 10
    chosen = [*animal, *[None] * 6, *rests, *[None] * 6, *shelf]
    time_s = 0.1 * np.arange(len(chosen))
    assert np.flatnonzero(movers.plausible(chosen, time_s, AnimalConfig())).tolist() == [
        *range(20),
        *range(26, 36),
    ]
    assert movers.plausible(shelf, time_s[:10], AnimalConfig()).all(), "no other track is known"


@pytest.mark.parametrize(
    ("similarity", "moved", "through", "presumed", "present"),
    [
        (3.0, 0.0, 0.0, False, True),
        (1.0, 0.9, 0.0, False, True),
        (-2.0, 0.3, 0.0, False, False),
        (-1.0, 0.5, 0.0, False, False),
        (0.5, 0.0, 0.0, True, False),
        (-1.5, 0.9, 0.9, True, True),
        (-1.5, 0.9, 0.0, True, False),
    ],
    ids=["rests", "walks", "mug", "rim", "guess", "tail", "drift"],
)
def test_presence_is_decided_by_appearance_and_motion(similarity, moved, through, presumed, present):
    shape = (10, 10)
    moving, seen_through = (np.arange(100).reshape(shape) < 100 * share for share in (moved, through))
    no = np.zeros(shape, bool)
    evidence = Evidence(np.zeros(shape), np.ones(shape), moving, moving, seen_through, no)
    instance = cast(Segmenter, SimpleNamespace())
    inside = ~no
    found = Segmenter._presence(instance, evidence, np.full(shape, similarity), inside, presumed)
    assert (found > 0) == present
    assert abs(found) < segmenter.LOG_ODDS_LIMIT + segmenter.PRESENCE_LIMIT


@pytest.mark.parametrize(
    ("share", "session", "turnaround"), [(1.0, "ok", "ok"), (0.5, "ok", "warn"), (0, "warn", "fail")]
)
def test_a_circled_animal_is_in_view_nearly_always(share, session, turnaround):
    seen = [frame < 20 * share for frame in range(20)]
    summary = writing.Summary(seen, [0.9] * 20, [0.1 * each for each in seen])
    states = [writing.checks_of(summary, 0.0, np.ones(10), circled)[0].status for circled in (False, True)]
    assert states == [session, turnaround]


def test_temporally_implausible_masks_are_reported():
    count, rng = 100, np.random.default_rng(0)
    good = Summary([True] * 60 + [False] * 40, [0.95] * count, [0.05] * 60 + [0.0] * 40)
    assert {check.status for check in writing.checks_of(good)} == {"ok"}
    unmeasured = replace(good, confidence=[np.nan] * count)
    assert {check.status for check in writing.checks_of(unmeasured)} == {"ok", "warn"}
    unsure = replace(good, confidence=[0.6] * count)
    jumping = replace(good, area=rng.choice([0.01, 0.05], count).tolist())
    flashing = replace(good, area=rng.choice([0.0, 0.05], count).tolist())
    for wrong in (unsure, jumping, flashing):
        assert "fail" in {check.status for check in writing.checks_of(wrong)}


def test_appearance_decides_without_geometry():
    """An animal at a place that no other frame observed is segmented by its appearance."""
    shape, unknown = (60, 80), np.zeros((60, 80), bool)
    animal = np.zeros(shape, bool)
    animal[20:40, 20:60] = True
    like = np.where(animal, 2.4, -4.0)
    evidence = Evidence(np.zeros(shape), np.full(shape, 0.05), unknown, unknown, unknown, unknown)
    window = cast(Window, SimpleNamespace(color=np.full((*shape, 3), 128, np.uint8)))
    instance = cast(Segmenter, SimpleNamespace(edges=Edges()))
    labels, _ = Segmenter._by_appearance(instance, window, evidence, like, SURE)
    assert ((labels == 255) & animal).sum() > 0.9 * animal.sum()
    assert not (labels == 255)[~animal].any()
    static = Evidence(np.full(shape, -3.0), np.ones(shape), unknown, unknown, unknown, ~unknown)
    labels, _ = Segmenter._by_appearance(instance, window, static, like, SURE)
    assert not (labels == 255).any()


def test_specular_surfaces_are_labeled_by_appearance():
    """A surface whose color changes beside the animal is labeled animal only if it looks like one."""
    shape, no = (60, 80), np.zeros((60, 80), bool)
    animal, gloss = no.copy(), no.copy()
    animal[20:40, 10:40], gloss[20:40, 40:75] = True, True
    like = np.where(animal, 2.0, -3.0)
    color_change = np.where(animal | gloss, 6.0, 0.0)
    evidence = Evidence(color_change - 2.0, np.ones(shape), animal, no, no, no, color_change)
    window = cast(Window, SimpleNamespace(color=np.full((*shape, 3), 128, np.uint8)))
    labels, _ = Segmenter._by_appearance(
        cast(Segmenter, SimpleNamespace(edges=Edges())), window, evidence, like, SURE
    )
    assert ((labels == 255) & animal).sum() > 0.8 * animal.sum()
    assert (labels == 255)[gloss].mean() < 0.1


def test_a_part_that_the_appearance_has_not_learned_stays_if_it_is_seen_through():
    shape = (40, 80)
    body, head, through = (np.zeros(shape, bool) for _ in range(3))
    body[10:30, 40:70], head[5:15, 10:20] = True, True
    labels = np.where(body | head, np.uint8(255), np.uint8(0))
    like = np.where(body, 2.0, -2.0)
    assert ((refine.remove_strays(labels, like, through) == 255) == body).all(), "a rim of furniture"
    through[5:8, 10:20] = True
    assert (refine.remove_strays(labels, like, through) == labels).all()


@pytest.mark.parametrize(("needed", "steps"), [(1, [10]), (4, [10, 20, 40]), (9, [10, 20, 40])])
def test_an_undertrained_appearance_is_trained_longer_before_it_is_given_up(needed, steps, monkeypatch):
    """Its recall suffices after ``needed`` times the steps of the settings."""
    labels, tried = np.full((20, 20), 255, np.uint8), []

    def learn(examples, options, rng, room):
        tried.append(options.steps)
        found = 1.0 if options.steps >= 10 * needed else -1.0
        return SimpleNamespace(log_odds=lambda color: np.full(color.shape[:2], found))

    monkeypatch.setattr(masks, "learn", learn)
    instance = SimpleNamespace(
        spheres=[Sphere(np.zeros(3), 1.0)] * 4,
        working_mask=lambda frame: SimpleNamespace(labels=labels),
        working_picture=lambda frame: np.zeros((20, 20, 3), np.uint8),
    )
    options = Config(learning=LearningConfig(steps=10))
    found = masks.learn_appearance(instance, None, options, np.random.default_rng(0))
    assert tried == steps and (found is not None) == (needed <= 4)


@pytest.mark.parametrize(
    ("tracked", "rounds"),
    [([4, 4], 1), ([4, 6, 6], 2), ([4, 6, 9, 12, 15], 3)],
    ids=["as many", "more once", "at most three"],
)
def test_appearance_is_learned_again_while_much_more_is_tracked(tracked, rounds, monkeypatch):
    """Numbers of tracked frames: by motion, then by each learned appearance."""
    found, learned = iter(tracked), []

    def find_mover(clip, poses, references, animal, prompt, appearance=None):
        return [Sphere(np.zeros(3), 1.0)] * next(found)

    def learn_appearance(segmenter, *_):
        learned.append(len(segmenter.spheres))
        return SimpleNamespace()

    monkeypatch.setattr(masks, "find_mover", find_mover)
    monkeypatch.setattr(masks, "learn_appearance", learn_appearance)
    monkeypatch.setattr(masks, "with_color_histogram", lambda each: each)
    monkeypatch.setattr(free_space, "masked", lambda references, hidden: references)
    rng = np.random.default_rng(0)
    last = masks._session_segmenter(None, None, None, None, Config(), rng)
    assert learned == tracked[:rounds] and len(last.spheres) == tracked[rounds]
