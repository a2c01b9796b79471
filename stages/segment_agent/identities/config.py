"""Settings of the network that distinguishes the animals of a home."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Config:
    """Training of the identity network."""

    portraits: int = 48
    """Pictures of each turnaround, spread evenly; a quarter of them is held out for testing."""
    steps: int = 2000
    """Training steps."""
    batch: int = 6
    """Crops per step."""
    crop_px: int = 144
    """Side of a crop at working resolution, pixels."""
    height_px: int = 320
    """Working height, pixels; larger pictures are downsampled to it."""
    seed: int = 0
    """Seed of the random numbers."""
