"""Settings of the behavior model and its training."""

from dataclasses import dataclass, field
from typing import Literal

from pipeline.behavior.config import AblatedInput, Control, Ego, Encoding, Family, ObservedPast, SceneEncoder

Weighting = Literal["noise", "velocity", "flow"]
"""Prediction target whose error has equal weight at all noise levels, see `objective.squared_error`."""


@dataclass(frozen=True)
class BehaviorOptimizerConfig:
    """Length and speed of training."""

    steps: int = 1000
    """Optimizer steps."""
    goal_steps: int = 200
    """Initial steps that train perception and goals alone; both are then frozen, since they overfit minutes
    of video long before path and body converge. 0: all are trained together, as in one-stage models."""
    batch: int = 64
    """Windows per step."""
    goal_batch: int = 64
    """Windows per step while perception and goals are trained alone."""
    rate: float = 2e-3
    """Peak learning rate of AdamW."""
    average: float = 0.995
    """Decay per step of the exponential moving average of the weights."""
    precision: Literal["float32", "bfloat16"] = "float32"
    """Precision of the costly convolutions of path, body and 3-D scenes; bfloat16 is faster on most GPUs."""
    compile: bool = False
    """Compile path and body (a minute, needs a C++ compiler); on a GPU each runs as one CUDA graph."""


@dataclass(frozen=True)
class AugmentationConfig:
    """Augmentation of training windows."""

    turn: float = 0.5
    """Probability of rotating the ego frame about its up axis by an arbitrary angle, otherwise by up to 0.3
    rad; 0: no rotation."""
    mirror: float = 0.5
    """Probability of mirroring left and right."""
    past: float = 0.3
    """Standard deviation of noise on the past motion, relative to its own; 0 also disables the shift of the
    observer by 0.05 m."""
    posture_offset: float = 0.5
    """Probability of a constant offset of past postures, as sampled postures have; without it, errors
    accumulate over chained plans."""
    hide_bones: float = 0.5
    """Dropout probability of past bones."""
    approached: float = 0.1
    """Share of samples drawn from windows with an approaching person, which are rare and matter, balanced
    over distances; the distribution of futures given the approach is unchanged."""
    approached_paths: float = 0.1
    """The same while path and body are trained, after goals."""


@dataclass(frozen=True)
class ObjectiveConfig:
    """Losses of a batch."""

    code_dropout: float = 0.1
    """Dropout on the perception code."""
    joint_dropout: float = 0.0
    """Probability of dropping scene, observer, past and goal or path together, for guidance on all of them;
    each is also dropped independently with probability 0.1."""
    weighting: Weighting = "velocity"
    """Error with equal weight at all noise levels: of the noise, as in the paper; of the velocity
    (v-prediction), which weights noisy steps, where the coarse shape is decided, more; or of the flow of
    rectified flow, with its noise levels in place of the paper's 50 linear ones."""
    path_share: float = 0.5
    """Share of a batch that trains paths, whose network is costly."""
    body_share: float = 0.5
    """Share of a batch that trains bodies, whose network is the costliest; 0: no bodies."""
    goal_draws: int = 8
    """Noise levels per window for the goal, whose network is small."""
    earlier_share: float = 0.7
    """Share of those draws that predict a position before the end of the horizon, since minutes of video
    contain few goals."""


@dataclass(frozen=True)
class BehaviorTrainingConfig:
    """Training settings of a recipe."""

    optimization: BehaviorOptimizerConfig = field(default_factory=BehaviorOptimizerConfig)
    """Length and speed."""
    augmentation: AugmentationConfig = field(default_factory=AugmentationConfig)
    """Augmentation of the windows."""
    objective: ObjectiveConfig = field(default_factory=ObjectiveConfig)
    """Losses."""


@dataclass(frozen=True)
class Config:
    """Settings of the behavior model and its training."""

    ego: Ego = "yaw"
    """Ego frame: the root's heading, its full rotation as in the paper, or, as an ablation, the world's axes
    and origin."""
    family: Family = "diffusion"
    """What is learned: goal, path and body by diffusion; each as a Gaussian; path and body at once without a
    goal."""
    control: Control = "unet"
    """Control by goal and path: a second UNet (ControlNet), or, as an ablation, concatenation to the
    perception code."""
    horizon_s: float = 5.6
    """Predicted seconds; a multiple of four frames (0.4 s at 10 Hz). The page needs 5.6 s."""
    export: bool = True
    """Write the files of the simulator (ONNX, pictures); off for the trials of the tables."""
    scene: SceneEncoder = "pillars"
    """Scene encoder: 2.5-D with height in 32 channels, or the six 3-D convolutions of 128 channels of the
    paper, or none, for trajectories without a map."""
    observed_past: ObservedPast = "positions"
    """Encoding of the observer's past: positions, with distance and approach speed as features, or SE(3)
    poses as in the paper; unknown rotations look at the agent."""
    encoding: Encoding = "strides"
    """What is diffused: paths as strides, goals by a power of their distance, bodies relative to the current
    posture; or, as in the paper, all as they are: positions, and bodies controlled by the path alone."""
    corrections: bool = True
    """Whether plans are moved out of solids, snapped to their goals and drawn again wherever the model is
    used; off: they are what the networks predict, as in the paper."""
    ensemble_size: int = 3
    """Size of the ensemble of perception and goal networks, whose predictions are averaged, against
    overfitting."""
    ablated_input: AblatedInput = "nothing"
    """Ablation: an input that the model never perceives."""
    observer_radius_m: float = 4.0
    """Horizontal distance in meters beyond which others are not perceived; at least 8 with companions."""
    unet_width: int = 16
    """Channels of the UNets' finest level; the next two have 2 and 4 times as many."""
    training: BehaviorTrainingConfig = field(default_factory=BehaviorTrainingConfig)
    """Length of training, augmentation, losses."""
    homes: tuple[str, ...] = ()
    """Other builds of the same animal that train goals and paths as well; bodies are trained on this build
    alone, since every build has bones of its own."""
    seed: int = 0
    """Seed of weights, batches and noise."""
