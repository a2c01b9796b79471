"""Settings of scoring."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Config:
    """Numbers of samples and windows."""

    seed: int = 0
    """Seed of the samples, the same for all methods."""
    samples: int = 16
    """Samples per window, the best of which counts (K)."""
    trials: int = 12
    """Trials of goals (L)."""
    stride: int = 1
    """Stride over the test windows that goals are scored on."""
    plan_stride: int = 16
    """Stride over the test windows that paths and bodies are scored on; one trial, at a hundred times the
    cost of goals."""
    approach_samples: int = 4
    """Plans per scripted approach."""
