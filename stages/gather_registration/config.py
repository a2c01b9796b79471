"""Settings of the gathered registration."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Config:
    """Requirements of the following stages."""

    min_registered: int = 1
    """Least number of registered sessions."""
