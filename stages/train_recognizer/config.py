"""Settings of the recognizer; constants that need no tuning stand beside the code that uses them."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Config:
    """Training of the recognizer."""

    steps: int = 1600
    """Training steps."""
    seed: int = 0
    """Seed of the random numbers."""
