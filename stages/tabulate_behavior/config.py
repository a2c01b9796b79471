"""Settings of the tables."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Config:
    """Methods that are compared, and numbers of trainings and samples."""

    methods: tuple[str, ...] = (
        "ats", "gaussian", "one_stage", "world", "no_observer", "no_scene", "no_past", "concatenation",
        "horizon_4_0", "horizon_7_2",
    )  # fmt: skip
    """Trained methods, which are variants in `agents/variants/`; `ats` is unchanged, `paper_small` the
    paper's with few steps."""
    seeds: int = 5
    """Trainings of each method."""
    trials: int = 12
    """Trials of the baselines without training."""
    rollouts: int = 20
    """Rollouts of the first trained model; 0: none."""
    rollout_s: float = 300.0
    """Length of each rollout, seconds."""
    seed: int = 0
    """Seed of samples and resampling."""
