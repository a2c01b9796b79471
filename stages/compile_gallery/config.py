"""Settings of `stages.compile_gallery`."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Config:
    """How big the pictures are."""

    thumbnail_px: int = 480
    """longer side of a thumbnail"""
