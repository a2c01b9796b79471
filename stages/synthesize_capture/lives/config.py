"""Settings of simulated lives."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Config:
    """How many lives, where, and how long."""

    seed: int = 0
    """Decides everything: homes, behavior, the person's walks."""
    homes: int = 24
    """Homes to learn from, differently furnished."""
    sessions_per_home: int = 1
    """Sessions in each of them, with its loose things elsewhere each time."""
    test_homes: int = 2
    """Homes that training never sees."""
    test_sessions: int = 8
    """Sessions in each of those: more of them narrow the intervals of all that is judged there."""
    session_s: float = 150.0
    """Length of a session, seconds."""
