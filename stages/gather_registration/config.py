"""Settings of the gathered registration."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Config:
    """What the rest of the flow needs."""

    min_registered: int = 1
    """Sessions that must be registered for the flow to go on."""
