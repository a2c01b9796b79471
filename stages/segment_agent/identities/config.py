"""Settings of distinguishing the animals of a home."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Config:
    """How the looks of several animals are learned."""

    portraits: int = 48
    """Pictures of each turnaround, spread evenly; a quarter of them is kept apart to test on."""
    steps: int = 1200
    """Training steps."""
    batch: int = 6
    """Crops per step."""
    crop_px: int = 144
    """Side of a crop at working resolution, pixels."""
    height_px: int = 320
    """Working height, pixels; larger pictures are worked on at this size."""
    seed: int = 0
    """Seed of the random numbers."""
