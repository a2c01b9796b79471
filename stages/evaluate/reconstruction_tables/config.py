"""Settings of the reconstruction tables."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Config:
    """How much is measured."""

    heldout_frames: int = 24
    """Frames of each held-out phone that are rendered."""
    lpips_weights: str = ""
    """Folder of LPIPS weights, as `[evaluate] lpips_weights`; empty: LPIPS is not measured."""
    seed: int = 0
    """Of the resampling."""
