"""Settings of `stages.train_longterm`."""

from dataclasses import dataclass, field
from typing import Literal

from pipeline.longterm.config import LongTermOptimizerConfig

Ablations = Literal["none", "baselines", "all"]


@dataclass(frozen=True)
class Config:
    """Training of the networks, and what they learn from."""

    body: LongTermOptimizerConfig = field(default_factory=lambda: LongTermOptimizerConfig(6.0, 32, 2e-3))
    """Training of the bodies at sub-goals."""
    route: LongTermOptimizerConfig = field(default_factory=LongTermOptimizerConfig)
    """Training of RouteNet."""
    pose: LongTermOptimizerConfig = field(default_factory=LongTermOptimizerConfig)
    """Training of PoseNet, with RouteNet held."""
    clip_stride: int = 3
    """Frames (30 fps) between the starts of two-second training clips."""
    max_bodies: int = 3000
    """Static bodies to learn from, about: of more frames, every second or third ... of a stretch is taken."""
    scene: bool = True
    """Whether RouteNet and PoseNet are conditioned on the scene."""
    ablations: Ablations = "none"
    """Which of the networks that the tables compare with to train too."""
    point_net: str | None = None
    """Weights (safetensors, named as in `longterm.safetensors`: `layers.0.weight` ...) every PointNet starts
    from.
    """
    smplx_model: str | None = None
    """Learn people instead: a model file of SMPL-X (needs the package smplx)."""
    smplx_motions: str | None = None
    """With it: a folder with `scene.ply` and recorded SMPL-X parameters (see
    `stages.train_longterm.sources.people`), or the folder of PROX as published.
    """
    seed: int = 0
    """Seed of weights, examples and batches."""
