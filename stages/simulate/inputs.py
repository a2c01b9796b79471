"""What a take is made of."""

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Inputs:
    """Finished artifacts; which ones are needed depends on the take."""

    behavior_data: Path
    """Trajectories and scenes."""
    behavior: Path | None = None
    """The behaviour model."""
    simulator: Path | None = None
    """Meshes of the live view."""
    longterm: Path | None = None
    """The model of long-term motion."""
    reconstruction: Path | None = None
    """The room's surface and the animal's body."""
    subgoals: Path | None = None
    """A TOML file of sub-goals."""
