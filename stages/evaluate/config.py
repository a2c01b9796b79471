"""Settings of the evaluation."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Config:
    """Numbers of frames and samples of the evaluation."""

    seed: int = 0
    """Seed of samples and resampling."""
    localizer_frames: int = 24
    """Single frames per session for the localizer and its baselines."""
    heldout_frames: int = 60
    """Frames of the held-out phone that are rendered."""
    surface_frames: int = 40
    """Frames per session for the comparison of the agent's surface."""
    samples: int = 16
    """Samples per window (K of the paper), the best of which counts."""
    trials: int = 4
    """Trials of `samples` goals per window, averaged: over 1,000 windows the sampling error is
    then half a centimeter, a tenth of the interval."""
    plan_windows: int = 120
    """Evenly spaced test windows for paths and bodies; goals are scored on all."""
    time_plans: bool = True
    """Measure seconds per plan; off if artifacts of two runs must be equal."""
    lpips_weights: str = ""
    """Folder with `alexnet.pth` (torchvision's ImageNet weights) and `lpips_alex.pth` (the `lpips` package's
    channel weights, v0.1) for LPIPS; empty: LPIPS is not measured."""
