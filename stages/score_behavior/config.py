"""Settings of scoring."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Config:
    """How many samples are drawn, and on which windows."""

    seed: int = 0
    """Of the samples; the same for every method."""
    samples: int = 16
    """Samples per window, the best of which counts (K)."""
    trials: int = 12
    """Trials of goals (L)."""
    stride: int = 1
    """Every how many test windows goals are scored."""
    plan_stride: int = 16
    """Every how many test windows paths and bodies are scored; they are sampled once, at a hundred times the
    cost."""
    approach_samples: int = 4
    """Plans per scripted approach."""
