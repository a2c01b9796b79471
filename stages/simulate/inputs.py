"""Input artifacts of a take."""

from dataclasses import dataclass
from pathlib import Path


@dataclass(frozen=True)
class Inputs:
    """Finished artifacts; which ones are needed depends on the take."""

    behavior_data: Path | None = None
    """Trajectories and scenes."""
    behavior: Path | None = None
    """The behavior model."""
    simulator: Path | None = None
    """Meshes of the live view."""
    longterm: Path | None = None
    """The model of long-term motion."""
    reconstruction: Path | None = None
    """The room's surface and the animal's body."""
    animals: Path | None = None
    """Folder of the animals of a home, each with its artifacts in a folder of its name: all live together."""
    home: Path | None = None
    """Folder of another finished build, in whose home the animal is to live."""
    feature_basis: Path | None = None
    """What the animal's own features are made of; needed in another home."""
    scene_template: Path | None = None
    """The animal's own home, its scale; needed in another home."""
    subgoals: Path | None = None
    """A TOML file of sub-goals."""
