"""Settings of long-term motion: network sizes, training, and motion optimization.

Standard library only, so that a stage's configuration can be read without torch.
"""

from dataclasses import dataclass


@dataclass(frozen=True)
class LongTermSizes:
    """Sizes that determine the networks' shapes; stored in `longterm.json`."""

    pose: int = 32
    """length of the pose code p, as of the body prior of SMPL-X"""
    shape: int = 0
    """length of the shape code (betas of SMPL-X); 0 for one animal"""
    latent: int = 32
    """length of the CVAE's code z"""
    scene: int = 128
    """length of the code of PointNet (the paper: 256)"""
    hidden: int = 96
    """width of each direction of the LSTMs"""
    width: int = 192
    """width of linear layers"""
    points: int = 128
    """scene points that PointNet sees"""


@dataclass(frozen=True)
class LongTermOptimizerConfig:
    """Length and learning rate of one network's training."""

    epochs: float = 20.0
    """passes over the examples, which `examples.MAX_CLIPS` and `max_bodies` limit (the paper: 20 for RouteNet
    and PoseNet, 40 for the CVAE)"""
    batch: int = 16
    """examples a step"""
    rate: float = 1e-3
    """peak learning rate of a cosine schedule"""


@dataclass(frozen=True)
class MotionOptimizationConfig:
    """Length of the optimization; its terms are `motion_optimization.MotionTerms`."""

    steps: int = 200
    """steps of Adam"""
    vertices: int = 300
    """surface vertices sampled for the collision and smoothness terms"""
