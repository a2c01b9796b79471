"""Settings for reading tables of motion."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Config:
    """Units and roles that a recording does not state itself."""

    rate_hz: float = 60.0
    """Frames per second of joint positions."""
    root_joint: int = 0
    """Joint at the pelvis: the animal's position."""
    front_joint: int = 3
    """Joint ahead of it: neck or shoulders."""
    cell_m: float = 0.1
    """Side of the obstacle map's cells in meters."""
