"""Settings of the evaluation."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Config:
    """How much is measured."""

    seed: int = 0
    """Of samples and resampling."""
    localizer_frames: int = 24
    """Single frames per session for the localizer and its rivals."""
    heldout_frames: int = 60
    """Frames of the held-out phone that are rendered."""
    surface_frames: int = 40
    """Frames per session on which the agent's surface is compared."""
    samples: int = 16
    """Samples per window (K of the paper), the best of which counts."""
    trials: int = 4
    """Trials of `samples` goals per window, averaged: over 1,000 windows the sampling error is
    then half a centimetre, a tenth of the interval."""
    plan_windows: int = 120
    """Test windows, evenly spaced, on which paths and bodies are judged; goals on all."""
    time_plans: bool = True
    """Measure seconds per plan; off where artifacts of two runs must be equal."""
    lpips_weights: str = ""
    """Folder with `alexnet.pth` (torchvision's ImageNet weights) and `lpips_alex.pth` (the `lpips` package's
    channel weights, v0.1) for LPIPS; empty: LPIPS is not measured."""
