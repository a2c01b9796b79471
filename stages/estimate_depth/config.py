"""Settings of depth for recordings without it; what nobody should turn stands beside its code."""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Config:
    """How recordings without depth get it."""

    length_m: float = 0.5
    """Length of the animal without its tail, metres: how high its back is where one looks from above."""
    backend: Literal["contact", "depth_anything_v2", "depth_pro"] = "contact"
    """The animal's depth in sessions: by where it touches the map, or by a metric monocular network (`make
    extras`, and its checkpoint), which the map's depth scales."""
    weights: str = ""
    """Folder of the network's checkpoint."""
    jpeg_quality: int = 95
    """JPEG quality 1..100 of pictures that were straightened; the others keep their bytes."""
    seed: int = 0
    """Seed of RANSAC."""
    role: Literal["turnaround", "session"] = "session"
    """Role of the recording where the list of recordings does not give it."""
