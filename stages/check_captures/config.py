"""Settings of the capture check."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Config:
    """Settings of the capture check."""

    samples: int = 40
    """Frames that are sampled per recording."""
    seed: int = 0
    """Seed of the robust fits."""
