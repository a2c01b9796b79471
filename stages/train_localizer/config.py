"""Settings of the localizers of the scene and of the agent."""

from dataclasses import dataclass, field
from typing import Literal


@dataclass(frozen=True)
class SceneConfig:
    """Views of the room."""

    views: int = 500
    """Rendered training views."""
    held_out: int = 80
    """Further views that measure the error and calibrate the uncertainty."""
    frames: int = 60
    """Frames of the walk-through added to the training views."""
    focal_px: float = 120.0
    """Focal length that pictures are resized to, pixels."""
    pitch_deg: tuple[float, float] = (-55.0, 15.0)
    """Pitch range of rendered cameras, degrees above the horizon."""


@dataclass(frozen=True)
class AgentConfig:
    """Views of the animal."""

    views: int = 250
    """Rendered training views."""
    held_out: int = 60
    """Further views that measure the error and calibrate the uncertainty."""
    distance_m: tuple[float, float] = (0.7, 3.5)
    """Distance range of rendered cameras, meters."""
    posture_deg: float = 0
    """Standard deviation of each joint's rotation per axis in rendered views, degrees; 0: the template's own
    posture. Reconstructed joints vary by 4 to 5 in turnarounds and by 5 to 11 in sessions (cat, dog)."""


@dataclass(frozen=True)
class NetworkConfig:
    """Size and training of the pose regressor."""

    steps: int = 2500
    """Steps of AdamW."""
    rate: float = 2e-3
    """Initial learning rate; cosine decay to a hundredth."""
    pose_width: int = 32
    """Channels of the first of four stages; 64 is the paper's ResNet-18."""
    batch_views: int = 64
    """Views per step."""
    fresh_views: int = 0
    """New views rendered per step, each replacing the oldest; 0: a fixed set."""


@dataclass(frozen=True)
class Config:
    """Which localizer is trained, and how."""

    target: Literal["scene", "agent"] = "scene"
    """Target of localization: the room or the animal."""
    kind: Literal["bank", "regression"] = "bank"
    """bank: nearest neighbors among patches of rendered views; regression: a network regresses the pose, as
    in the paper."""
    scene: SceneConfig = field(default_factory=SceneConfig)
    """Views of the room."""
    agent: AgentConfig = field(default_factory=AgentConfig)
    """Views of the animal."""
    network: NetworkConfig = field(default_factory=NetworkConfig)
    """The pose regressor."""
    seed: int = 0
    """Seed of views, noise and RANSAC."""
