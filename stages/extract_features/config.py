"""Settings of feature extraction."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Config:
    """Nothing to set: the descriptor is chosen where its basis is fitted."""
