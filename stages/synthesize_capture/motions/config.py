"""Settings of the built-in animal's long-term motion."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Config:
    """How much motion, in how many homes."""

    seed: int = 0
    """Decides everything: homes, the animal's life, the person's walks."""
    homes: int = 9
    """Homes, differently furnished; the last one is unseen in training."""
    session_s: float = 200.0
    """Length of a session, seconds."""
