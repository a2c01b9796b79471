"""Settings of the registration tables."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Config:
    """How sure the comparison is."""

    seed: int = 0
    """Of the resampling."""
