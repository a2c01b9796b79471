"""Settings of the built-in capture."""

from dataclasses import dataclass
from typing import Literal

Species = Literal["cat", "dog", "rabbit", "hen"]


@dataclass(frozen=True)
class Config:
    """What to film."""

    seed: int = 0
    """Decides everything: room, coat, light, behavior, noise."""
    session_count: int = 6
    """Recordings of the animal's life; the last is the test video."""
    session_s: float = 60.0
    """Length of a session, seconds."""
    test_session_s: float = 120.0
    """Length of the last session, seconds: a minute holds too few windows of 6.4 s to compare methods."""
    walkthrough_s: float = 45.0
    """Length of the walk through the empty room, seconds."""
    turnaround_s: float = 20.0
    """Length of the circle around the standing animal, seconds."""
    heldout_of: int = 2
    """Session (from 1) that a second phone films from the other side; 0 = none."""
    dim_session: int = 3
    """Session (from 1) filmed in the evening; 0 = none."""
    sideways_session: int = 4
    """Session (from 1) filmed with the phone held sideways; 0 = none."""
    foreign_sessions: int = 0
    """Additional sessions, each filmed in another home: registration is to refuse them."""
    species: Species = "cat"
    """The animal that lives here: its body, coat and gait; where it goes and why is the same for all."""
    companion: Literal["none", "dog"] = "none"
    """A second animal of another species: it follows the first, plays with it and avoids it."""
    visitor_sessions: tuple[int, ...] = ()
    """Sessions (from 1) in which another person walks about the room."""
