"""Settings of `stages.tabulate_longterm`."""

from dataclasses import dataclass, field

from pipeline.longterm.config import MotionOptimizationConfig


@dataclass(frozen=True)
class Config:
    """How much is measured."""

    clips: int = 300
    """Two-second motions of each source, in consecutive pairs, evenly chosen among those that travel over 0.5
    m.
    """
    optimized_clips: int = 24
    """How many of them are also optimized: of reconstructed motion ours alone, of the built-in world all
    methods.
    """
    optimization: MotionOptimizationConfig = field(default_factory=MotionOptimizationConfig)
    """Length of the optimization."""
    minutes_s: float = 300.0
    """Length of the long motion, seconds; 0 = none."""
    subgoals: int = 20
    """Sub-goals of the long motion."""
    samples: int = 60
    """Samples of the behavior model that are made physical; 0 = none."""
    seed: int = 0
    """Seed of the choice of clips, the CVAE's codes, samples and resampling."""
