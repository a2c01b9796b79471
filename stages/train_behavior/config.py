"""Settings of the behaviour model and its training."""

from dataclasses import dataclass, field
from typing import Literal

from pipeline.behavior.config import AblatedInput, Control, Ego, Family, MapLookup, ObservedPast, SceneEncoder

Weighting = Literal["noise", "velocity", "flow"]
"""Which error has equal weight at all noise levels, see `objective.squared_error`."""


@dataclass(frozen=True)
class BehaviorOptimizerConfig:
    """Length and speed of training."""

    steps: int = 1000
    """Optimizer steps."""
    goal_steps: int = 200
    """First steps, in which perception and goals are trained alone; both are frozen after them, for they
    overfit minutes of video long before path and body are good. 0: all are trained together, as one-stage
    models always are."""
    batch: int = 64
    """Windows per step."""
    goal_batch: int = 64
    """Windows per step while perception and goals are trained alone."""
    rate: float = 2e-3
    """Peak learning rate of AdamW."""
    average: float = 0.995
    """Decay per step of the exponential moving average of the weights."""
    precision: Literal["float32", "bfloat16"] = "float32"
    """Of the convolutions of path and body, which cost the most; mixed precision is faster on most GPUs."""
    compile: bool = False
    """Compile path and body, which takes a minute and a C++ compiler; on a GPU each runs as one CUDA graph.
    """


@dataclass(frozen=True)
class AugmentationConfig:
    """How far training samples are from the recorded ones."""

    turn: float = 0.5
    """Probability of rotating the ego frame about its up axis by any angle; the others rotate by up to 0.3
    rad. 0 rotates none."""
    mirror: float = 0.5
    """Probability of mirroring left and right."""
    past: float = 0.3
    """Standard deviation of noise on the remembered motion, in its own standard deviations; 0 also leaves the
    observer where it was, who else is shifted by 0.05 m."""
    posture_offset: float = 0.5
    """Probability that the remembered posture is off by a constant, as sampled postures are; without it
    errors add up over chained plans."""
    hide_bones: float = 0.5
    """Probability that a sample's remembered bones are hidden."""
    approached: float = 0.1
    """Share of samples drawn from windows that begin with a person coming up, near and far alike, which are
    few and matter; what follows is as likely in them as ever."""
    approached_paths: float = 0.1
    """The same while path and body are trained apart from goals."""


@dataclass(frozen=True)
class ObjectiveConfig:
    """How a batch becomes losses."""

    code_dropout: float = 0.1
    """Dropout on the perception code."""
    joint_dropout: float = 0.0
    """Probability that scene, observer, past and goal or path are dropped together, so that guidance may act
    on all of them at once; each is also dropped on its own with probability 0.1."""
    weighting: Weighting = "velocity"
    """Error with equal weight at all noise levels: of the noise, as in the paper; of the velocity, which
    gives noisy steps, where the outline is decided, their share; or of the straight line of rectified flow,
    with its noise levels in place of the 50 linear ones of the paper."""
    motion_weight: float = 4.0
    """Weight of the change of a body's error from frame to frame beside the error itself (velocity loss of
    Tevet et al. 2022): errors that change make feet skate."""
    path_share: float = 0.5
    """Share of a batch's windows that paths, whose network is costly, are trained on in a step."""
    body_share: float = 0.5
    """Share of a batch's windows that bodies, whose network is the costliest, are trained on in a step; 0
    trains none."""
    goal_draws: int = 8
    """Noise levels per window for the goal, whose network is small."""
    earlier_share: float = 0.7
    """Share of those draws whose target is where the animal is before the horizon ends: minutes of video hold
    few goals."""


@dataclass(frozen=True)
class BehaviorTrainingConfig:
    """Everything that a recipe sets about training."""

    optimization: BehaviorOptimizerConfig = field(default_factory=BehaviorOptimizerConfig)
    """Length and speed."""
    augmentation: AugmentationConfig = field(default_factory=AugmentationConfig)
    """Augmentation of the windows."""
    objective: ObjectiveConfig = field(default_factory=ObjectiveConfig)
    """Losses."""


@dataclass(frozen=True)
class Config:
    """Settings of the behaviour model and its training."""

    ego: Ego = "yaw"
    """Ego frame: the root's heading, its full rotation as in the paper, or, as an ablation, the world's axes
    and origin."""
    family: Family = "diffusion"
    """What is learned: goal, path and body by diffusion; each as a Gaussian; path and body at once without a
    goal."""
    control: Control = "unet"
    """How goal and path condition: by a second UNet, or, as an ablation, as one more part of the perception
    code."""
    horizon_s: float = 5.6
    """Seconds that are predicted; a multiple of four frames (0.4 s at 10 Hz). The page needs 5.6 s."""
    export: bool = True
    """Write what the simulator needs (ONNX, golden plan, pictures); off for the trials of the tables."""
    scene: SceneEncoder = "pillars"
    """Scene encoder: 2.5-D with height in 32 channels, or the six 3-D convolutions of 128 channels of the
    paper, or none, for trajectories without a map."""
    observed_past: ObservedPast = "positions"
    """What is read of the observer's past: positions, from which distance and approach are computed, or SE(3)
    poses as in the paper; where rotations are not known, the observer looks at the agent."""
    ensemble_size: int = 3
    """Perception and goal networks that are trained side by side and whose predictions are averaged, against
    overfitting."""
    ablated_input: AblatedInput = "nothing"
    """Ablation: an input that the model never perceives."""
    observer_radius_m: float = 4.0
    """Horizontal distance in metres beyond which an observer is not perceived."""
    unet_width: int = 16
    """Channels of the UNets' finest level; the next two have 2 and 4 times as many."""
    map_lookup: MapLookup = "attention"
    """How goals read the map of the 2.5-D encoder: by attention, or, as in the released code, at the noisy
    point itself; then paths read it too, at each noisy waypoint."""
    training: BehaviorTrainingConfig = field(default_factory=BehaviorTrainingConfig)
    """Length of training, augmentation, losses."""
    homes: tuple[str, ...] = ()
    """Further builds of the same animal, from which goals and paths are learned as well; bodies are learned
    from this build alone, since every build has bones of its own."""
    seed: int = 0
    """Seed of weights, batches and noise."""
