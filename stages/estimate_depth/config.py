"""Settings of depth estimation; constants that need no tuning stand beside the code that uses them."""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Config:
    """Depth estimation for recordings without depth."""

    length_m: float = 0.5
    """Length of the animal without its tail, meters; gives the height of its back."""
    backend: Literal["contact", "depth_anything_v2", "depth_pro"] = "contact"
    """The animal's depth in sessions: by its contact with the map, or by a monocular network (`make extras`,
    and its checkpoint) scaled by the map's depth."""
    weights: str = ""
    """Folder of the network's checkpoint."""
    jpeg_quality: int = 95
    """JPEG quality 1..100 of undistorted pictures; the others are copied."""
    seed: int = 0
    """Seed of RANSAC."""
    role: Literal["turnaround", "session"] = "session"
    """Role of the recording where the list of recordings does not give it."""
