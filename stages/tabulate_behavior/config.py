"""Settings of the tables."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Config:
    """Which methods are compared, and how often each is trained."""

    methods: tuple[str, ...] = (
        "ats",
        "gaussian",
        "one_stage",
        "world",
        "no_observer",
        "no_scene",
        "no_past",
        "concatenation",
        "horizon_4_0",
        "horizon_7_2",
    )
    """Trained methods: variants in `agents/variants/`; `ats` changes nothing."""
    seeds: int = 5
    """Trainings of each method."""
    trials: int = 12
    """Trials of the rivals that need no training."""
    rollouts: int = 20
    """Chained lives of the first trained model; 0: none."""
    rollout_s: float = 300.0
    """Length of each, seconds."""
    seed: int = 0
    """Of samples and resampling."""
