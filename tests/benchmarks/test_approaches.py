"""What ends an approach: the animal's own motion decides, whatever moved it."""

import numpy as np
import pytest

from benchmarks.approaches import flights, judged

STEPS = 41


def along(distance_m: np.ndarray) -> np.ndarray:
    """Return one path along x, at these distances from the origin."""
    return np.stack([distance_m, np.zeros_like(distance_m)], axis=-1)[None]


PERSON = np.zeros((1, STEPS, 2))
STAY, RUN = np.full(STEPS, 1.5), np.r_[np.full(20, 1.5), np.linspace(1.5, 3.0, STEPS - 20)]


def test_flight_begins_where_the_animal_gets_away_fast():
    begins = flights(PERSON, along(RUN))[0]
    first = int(np.argmax(begins))
    moved_m = RUN[first + 15] - 1.5
    assert begins.any()
    assert moved_m > 0.8
    assert RUN[first + 14] - 1.5 <= 0.8
    assert not flights(PERSON, along(STAY)).any()
    assert not flights(PERSON, along(np.linspace(1.5, 3.0, STEPS))).any(), "walks off slowly"
    assert not flights(PERSON, along(RUN + 1.5)).any(), "nobody is near"


@pytest.mark.parametrize(
    ("distance_m", "reached", "fled", "seconds"),
    [
        (np.linspace(1.5, 0.5, STEPS), True, False, 3.3),
        (RUN, False, True, 1.6),
        (STAY, False, False, 4.0),
        (np.r_[np.linspace(1.5, 0.6, 20), np.linspace(0.6, 3.0, STEPS - 20)], False, True, None),
    ],
)
def test_an_episode_ends_by_what_comes_first(distance_m, reached, fled, seconds):
    episode = judged(PERSON, along(distance_m), np.zeros(1, int))
    assert (episode.reached[0], episode.fled[0]) == (reached, fled)
    if seconds is not None:
        assert episode.seconds[0] == pytest.approx(seconds)
    end = round(10 * episode.seconds[0])
    assert np.isfinite(episode.animal_paths[0, : end + 1]).all()
    assert np.isnan(episode.animal_paths[0, end + 1 :]).all()
