"""Settings of slicing."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Config:
    """Filtering, resampling and windowing of motion."""

    min_confidence: float = 0.3
    """Minimum confidence (0..1) of frames; others count as missing."""
    max_gap_s: float = 0.6
    """Longest interpolated gap, seconds."""
    smooth_s: float = 0.08
    """Standard deviation of the Gaussian that smooths the agent's root, seconds; 0: none."""
    past_s: float = 0.8
    """Length of the past of agent and others that the model sees, seconds."""
    rate_hz: float = 10.0
    """Frames per second of the model; page, simulator and environments need 10. `horizon_s` of
    [train_behavior] sets the horizon."""
    stride: int = 1
    """Stride between training windows, frames."""
    others: tuple[str, ...] = ()
    """Names of the home's other animals, which become companions; set by the planner."""
