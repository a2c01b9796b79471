"""Settings of `stages.export`."""

from dataclasses import dataclass
from typing import Literal

Format = Literal["glb", "splats", "usd", "bvh", "mjcf", "tables", "movement", "nwb", "nerfstudio", "colmap"]


@dataclass(frozen=True)
class Config:
    """What is written."""

    format: Format = "glb"
    """one of the formats above"""
    rate_hz: float = 30.0
    """keys of animations, per second"""
    pictures_per_video: int = 150
    """frames of each recording, evenly spread, for nerfstudio and colmap, which alone hold pictures"""
