"""Settings of the annotation page."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Config:
    """What is shown to click in."""

    frames: int = 4
    """Frames per session and held-out phone."""
    references: int = 30
    """Frames of the walk-through."""
