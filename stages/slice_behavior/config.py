"""Settings of slicing."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Config:
    """Which motion is trusted, and how densely it is cut into windows."""

    min_confidence: float = 0.3
    """Frames whose motion has less confidence (0..1) count as missing."""
    max_gap_s: float = 0.6
    """Longest gap in seconds that is interpolated."""
    smooth_s: float = 0.08
    """Standard deviation in seconds of the smoothing of the agent's root; 0 for none."""
    past_s: float = 0.8
    """Seconds that the model knows of agent and others."""
    rate_hz: float = 10.0
    """Frames per second that it learns; page, simulator and environments play 10. `horizon_s` of
    [train_behavior] sets how far it sees ahead."""
    stride: int = 1
    """Frames between starts of training windows."""
    others: tuple[str, ...] = ()
    """Names of the home's other animals, whose motion is read as companions; the planner sets it."""
