"""Settings of the appearance network."""

from dataclasses import dataclass


@dataclass(frozen=True)
class LearningConfig:
    """Training of the appearance network on the first masks of the same recording."""

    examples: int = 150
    """Number of training frames that show the animal."""
    steps: int = 300
    """Training steps."""
    batch: int = 6
    """Crops per step."""
    crop_px: int = 144
    """Side of a crop at working resolution, pixels."""
