"""Settings of segmentation; constants that need no tuning stand beside the code that uses them."""

from dataclasses import dataclass, field
from typing import Literal

from pipeline.segmentation.config import LearningConfig


@dataclass(frozen=True)
class FoundationConfig:
    """Checkpoints that detect and track the animal, and the text prompt."""

    detector: str = ""
    """Folder of a Grounding DINO checkpoint; not needed where a prompt points at the animal."""
    tracker: str = ""
    """Folder of a SAM 2 checkpoint."""
    description: str = "a cat."
    """Text prompt for the detector."""
    threshold: float = 0.3
    """Minimum detection score, 0..1."""


@dataclass(frozen=True)
class AnimalConfig:
    """Limits on the animal's size and speed."""

    largest_m: float = 1.3
    """Largest extent of an animal, meters; groups up to twice as large get half the score."""
    speed_m_s: float = 2.5
    """Speed up to which tracking charges no cost, meters per second."""


@dataclass(frozen=True)
class Config:
    """How the animal is found in one recording."""

    backend: Literal["weightless", "foundation"] = "weightless"
    """Motion, free space and appearance, or Grounding DINO and SAM 2 (`make extras`, and checkpoints)."""
    foundation: FoundationConfig = field(default_factory=FoundationConfig)
    """Settings of the backend `foundation`."""
    learning: LearningConfig = field(default_factory=LearningConfig)
    """Training of the appearance network."""
    animal: AnimalConfig = field(default_factory=AnimalConfig)
    """Size and speed of the animal."""
    references: int = 90
    """Number of depth pictures, evenly spaced in time, that vote on which space is free at other times."""
    height_px: int = 320
    """Working height, pixels; larger pictures are downsampled to it."""
    role: Literal["turnaround", "session"] = "session"
    """Role of the recording where the list of recordings does not give it."""
    seed: int = 0
    """Seed of the random numbers."""
