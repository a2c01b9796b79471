"""Settings of the registration of sessions."""

from dataclasses import dataclass, field
from typing import Literal


@dataclass(frozen=True)
class VoteConfig:
    """Which frames vote for a pose, and when votes agree."""

    every_frames: int = 5
    """One frame in so many is localized."""
    min_probability: float = 0.2
    """Poses below this probability do not vote."""
    agree_deg: float = 8.0
    """Votes agree within this rotation, degrees ..."""
    agree_m: float = 0.3
    """... and this distance, metres; room for the odometry's drift."""
    max_tilt_deg: float = 10.0
    """Poses that contradict gravity by more than this do not vote, degrees."""


@dataclass(frozen=True)
class AlignmentConfig:
    """Terms and rounds of the alignment of all frames."""

    rounds: int = 8
    """Gauss-Newton steps by depth and votes; 0: poses stay as votes and odometry give them."""
    stride_px: int = 11
    """One depth pixel in so many, each way, takes part."""
    flow_every_frames: int = 5
    """One frame in so many is aligned by optical flow from the rendered template; 0: none."""
    feature_every_frames: int = 5
    """One frame in so many is aligned by features against the template's features (feature-metric alignment);
    0: none."""


@dataclass(frozen=True)
class GateConfig:
    """When an aligned recording is accepted."""

    min_fit: float = 0.35
    """Median share of a frame's static depth that must lie within 5 cm of the template."""
    min_certainty: float = 0.5
    """Probability of a vote that needs no confirmation by appearance."""
    min_appearance: float = 0.3
    """Share of the frames that must look more like their renderings than like renderings from wrong poses."""


@dataclass(frozen=True)
class ConfidenceConfig:
    """How each frame's confidence is measured."""

    every_frames: int = 5
    """One frame in so many is compared with its rendering."""
    decoys: int = 120
    """Renderings from poses that are wrong on purpose."""


@dataclass(frozen=True)
class RootConfig:
    """How the animal is placed."""

    headings: int = 12
    """Headings tried from scratch in every frame."""
    smooth_s: float = 0.15
    """Time constant of the smoothing, seconds."""


@dataclass(frozen=True)
class Config:
    """How a recording is registered."""

    initialization: Literal["votes", "middle"] = "votes"
    """votes: localized frames place the recording; middle: it starts in the middle of the room with the
    heading of its odometry, and is never refused (the ablation without a localizer)."""
    odometry: Literal["device", "pictures"] = "device"
    """device: its own poses where the recording has them; pictures: visual odometry with depth, always."""
    vote: VoteConfig = field(default_factory=VoteConfig)
    """Single-frame localization."""
    alignment: AlignmentConfig = field(default_factory=AlignmentConfig)
    """All frames against the template."""
    gate: GateConfig = field(default_factory=GateConfig)
    """When a recording is accepted."""
    confidence: ConfidenceConfig = field(default_factory=ConfidenceConfig)
    """Confidence of the camera poses."""
    animal: bool = True
    """False: cameras alone, for tables that compare nothing else."""
    root: RootConfig = field(default_factory=RootConfig)
    """The animal's root."""
    seed: int = 0
    """Seed of subsampling and calibration."""
