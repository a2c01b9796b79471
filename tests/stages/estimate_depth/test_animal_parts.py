"""The animal is followed among parts that look like it: what stays and what jumps is not it."""

import numpy as np
import pytest

from pipeline.geometry.contact import Contact
from stages.estimate_depth.animal_parts import JUMP_COST, MAX_M_S, SLACK_M, Part, follow, static_shares
from stages.estimate_depth.views import View

COUNT = 30
TIME_S = 0.1 * np.arange(COUNT)
ANIMAL, BOX, ANY = 100.0, 300.0, np.ones((4, 4), bool)
BOX_AT = np.array([0.5, 0.0, 3.0])


@pytest.fixture(scope="module")
def views():
    intrinsics, gray = np.array([[100.0, 0, 80], [0, 100.0, 60], [0, 0, 1]]), np.zeros((120, 160), np.uint8)
    return [View(gray, intrinsics, np.eye(4), np.ones(gray.shape)) for _ in range(COUNT)]


def part(point, evidence):
    return Part([ANY], [None if point is None else Contact(np.asarray(point, float), True)], evidence)


def walk(frame):
    return [-1.0 + 0.07 * frame, 0.0, 4.0]


def evidence_of(chosen):
    return [each and each.evidence for each in chosen]


@pytest.mark.parametrize("covers", [range(COUNT), range(10, 20)])
def test_walking_animal_is_followed_past_a_box_that_resembles_it_more(views, covers):
    parts = [[part(walk(frame), ANIMAL)] for frame in range(COUNT)]
    for frame in covers:
        parts[frame].insert(0, part(BOX_AT, BOX))
    assert evidence_of(follow(parts, views, TIME_S)) == [ANIMAL] * COUNT


def test_lone_animal_that_rests_is_kept(views):
    parts = [[part(BOX_AT, ANIMAL)] for _ in range(COUNT)]
    assert evidence_of(follow(parts, views, TIME_S)) == [ANIMAL] * COUNT


def test_box_is_not_the_animal_where_that_is_hidden(views):
    hidden = range(12, 15)
    parts = [
        [part(BOX_AT, 0.05 * ANIMAL)] + ([] if frame in hidden else [part(walk(frame), ANIMAL)])
        for frame in range(COUNT)
    ]
    found = evidence_of(follow(parts, views, TIME_S))
    assert found == [None if frame in hidden else ANIMAL for frame in range(COUNT)]


def test_what_is_far_smaller_is_not_the_animal_while_it_is_away(views):
    parts = [[part(walk(frame), ANIMAL if frame < COUNT // 3 else 0.01 * ANIMAL)] for frame in range(COUNT)]
    found = evidence_of(follow(parts, views, TIME_S))
    assert found == [ANIMAL if frame < COUNT // 3 else None for frame in range(COUNT)]


def test_what_jumps_there_and_back_is_not_the_animal(views):
    """Evidence alone prefers the flash, by less than two jumps cost."""
    far_m = MAX_M_S * 0.1 + SLACK_M + 0.5
    ratio = np.exp(0.9 * 2 * JUMP_COST)
    parts = [[part([0.0, 0.0, 4.0], ANIMAL)] for _ in range(COUNT)]
    parts[15].append(part([far_m, 0.0, 4.0], ANIMAL * ratio))
    assert evidence_of(follow(parts, views, TIME_S)) == [ANIMAL] * COUNT


def test_frames_without_parts_and_points(views):
    assert follow([[] for _ in views], views, TIME_S) == [None] * COUNT
    parts = [[part(None, ANIMAL)] if frame % 3 else [] for frame in range(COUNT)]
    assert evidence_of(follow(parts, views, TIME_S)) == [
        ANIMAL if frame % 3 else None for frame in range(COUNT)
    ]


def test_static_share_counts_frames_that_see_the_place(views):
    points = [np.array([BOX_AT]) if frame < 15 else np.zeros((0, 3)) for frame in range(COUNT)]
    shares = static_shares(points, views, TIME_S)
    others = np.abs(TIME_S - TIME_S[0]) > 0.7
    assert shares[0][0] == pytest.approx(others[:15].sum() / others.sum())
    assert len(shares[20]) == 0
    behind = [np.array([[0.0, 0.0, -3.0]])] * COUNT
    assert static_shares(behind, views, TIME_S)[0][0] == 0.0
