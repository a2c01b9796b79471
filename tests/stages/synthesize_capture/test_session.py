"""Behavior of the simulated animal: it moves, stays on free floor, and flees only when approached."""

import numpy as np

from stages.synthesize_capture import review, room
from stages.synthesize_capture.navigation import floor_for
from stages.synthesize_capture.observer import AT_HOME, FILMING
from stages.synthesize_capture.policy import REASONS, STEP_S, Policy, SeenWalker
from stages.synthesize_capture.session import simulate_session

HOME = room.furnish(np.random.default_rng(0))


def test_session_is_deterministic():
    first, second = (simulate_session(HOME, np.random.default_rng(5), 8.0) for _ in range(2))
    np.testing.assert_array_equal(first.animal.position, second.animal.position)
    np.testing.assert_array_equal(first.observer_looks_at, second.observer_looks_at)


def test_residents_approach_from_farther_than_observers():
    nearest = []
    for style in (FILMING, AT_HOME):
        lived = simulate_session(HOME, np.random.default_rng(5), 40.0, style)
        away = np.linalg.norm(lived.animal.position[:, [0, 2]] - lived.observer_position, axis=-1)
        walks = (
            np.linalg.norm(
                np.diff(lived.observer_position, axis=0, append=lived.observer_position[-1:]), axis=-1
            )
            > 0.02
        )
        nearest.append(np.median(away[walks & (np.gradient(away) < 0)]))
    assert nearest[1] > nearest[0]


def test_activities_over_minutes():
    sessions = [simulate_session(HOME.arranged(rng), rng, 60.0) for rng in np.random.default_rng(7).spawn(5)]
    manner = review.manner(sessions)
    assert manner.moving_windows >= 0.4
    assert manner.flees_when_approached > 0.6
    assert manner.flees_when_left_alone < 0.1
    assert all(
        np.isfinite(lived.animal.position).all() and lived.animal.speed().max() < 4.0 for lived in sessions
    )
    inside = np.concatenate([lived.animal.position for lived in sessions])
    assert (np.abs(inside[:, 0]) < room.WIDTH_M / 2).all()
    assert (np.abs(inside[:, 2]) < room.DEPTH_M / 2).all()


def test_distant_or_static_person_causes_no_flight():
    floor = floor_for([], (0.24, 0.3))
    for seen in (
        SeenWalker(np.array([2.8, 2.2]), np.array([-0.9, -0.9])),
        SeenWalker(np.array([-0.6, -1.0]), np.zeros(2)),
    ):
        cat = Policy(floor, HOME.places, np.array([-2.0, -1.6]), np.random.default_rng(1))
        for _ in range(20):
            cat.step(STEP_S, seen)
            assert cat.reason != REASONS[1]


def test_animal_flees_from_an_approaching_person():
    floor = floor_for([], (0.24, 0.3))
    for angle in np.linspace(0, 2 * np.pi, 7):
        toward = np.array([np.sin(angle), np.cos(angle)])
        cat = Policy(floor, HOME.places, np.zeros(2), np.random.default_rng(2))
        for _ in range(45):
            cat.step(STEP_S, SeenWalker(-1.2 * toward, 1.1 * toward))
        assert cat.walker.position @ toward > 0.5, "meters along the way from the person to it"
