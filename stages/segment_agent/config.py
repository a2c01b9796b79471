"""Settings of segmentation; what nobody should turn stands beside the code that uses it."""

from dataclasses import dataclass, field
from typing import Literal


@dataclass(frozen=True)
class FoundationConfig:
    """Which models find and follow the animal, and what they look for."""

    detector: str = ""
    """Folder of a Grounding DINO checkpoint; not needed where a prompt points at the animal."""
    tracker: str = ""
    """Folder of a SAM 2 checkpoint."""
    description: str = "a cat."
    """What the animal is called."""
    threshold: float = 0.3
    """Score from which a detection counts, 0..1."""


@dataclass(frozen=True)
class LearningConfig:
    """How the animal's appearance is learned from first masks of the same recording."""

    examples: int = 150
    """Frames with the animal to learn from."""
    steps: int = 300
    """Training steps."""
    batch: int = 6
    """Crops per step."""
    crop_px: int = 144
    """Side of a crop at working resolution, pixels."""


@dataclass(frozen=True)
class AnimalConfig:
    """What an animal may be like."""

    largest_m: float = 1.3
    """Largest extent of an animal, metres; groups that are larger, up to twice that, count half."""
    speed_m_s: float = 2.5
    """Fastest motion that costs nothing much, metres per second."""


@dataclass(frozen=True)
class Config:
    """How the animal is found in one recording."""

    backend: Literal["weightless", "foundation"] = "weightless"
    """By motion, free space and appearance, or by Grounding DINO and SAM 2 (`make extras`, weights)."""
    foundation: FoundationConfig = field(default_factory=FoundationConfig)
    """Settings of the latter."""
    learning: LearningConfig = field(default_factory=LearningConfig)
    """How appearance is learned."""
    animal: AnimalConfig = field(default_factory=AnimalConfig)
    """Size and speed of the animal."""
    references: int = 90
    """Depth pictures, spread evenly over the recording, that decide which space is free at other times."""
    height_px: int = 320
    """Working height, pixels; larger pictures are worked on at this size."""
    role: Literal["turnaround", "session"] = "session"
    """Role of the recording where the list of recordings does not give it."""
    seed: int = 0
    """Seed of the random numbers."""
