"""Settings of the registration of sessions."""

from dataclasses import dataclass, field
from typing import Literal


@dataclass(frozen=True)
class VoteConfig:
    """Localization of single frames, and agreement of their votes."""

    every_frames: int = 5
    """Stride of the localized frames."""
    min_probability: float = 0.2
    """Poses below this probability do not vote."""
    agree_deg: float = 8.0
    """Votes agree within this rotation, degrees ..."""
    agree_m: float = 0.3
    """... and this distance, meters; room for the odometry's drift."""
    max_tilt_deg: float = 10.0
    """Poses that contradict gravity by more than this do not vote, degrees."""


@dataclass(frozen=True)
class AlignmentConfig:
    """Terms and rounds of the alignment of all frames."""

    rounds: int = 8
    """Gauss-Newton steps by depth and votes; 0: keep the poses of votes and odometry."""
    stride_px: int = 11
    """Grid spacing of the depth pixels."""
    flow_every_frames: int = 5
    """Stride of the frames aligned by optical flow from the rendered template; 0: none."""
    feature_every_frames: int = 5
    """Stride of the frames of feature-metric alignment to the template's features; 0: none."""


@dataclass(frozen=True)
class GateConfig:
    """When an aligned recording is accepted."""

    min_fit: float = 0.35
    """Median share of a frame's static depth that must lie within 5 cm of the template."""
    min_certainty: float = 0.5
    """Probability of a vote that needs no confirmation by appearance."""
    min_appearance: float = 0.3
    """Least share of the frames that match their renderings better than renderings from wrong poses."""


@dataclass(frozen=True)
class ConfidenceConfig:
    """How each frame's confidence is measured."""

    every_frames: int = 5
    """Stride of the frames compared with their rendering."""
    decoys: int = 120
    """Number of renderings from deliberately wrong poses."""


@dataclass(frozen=True)
class RootConfig:
    """How the animal is placed."""

    initialization: Literal["headings", "localizer"] = "headings"
    """headings: fits from all headings and the localizer's poses, chosen by a Viterbi path, tracked and
    smoothed; localizer: each frame's best pose by the localizer as it is, as in the paper."""
    headings: int = 12
    """Initial headings in every frame."""
    smooth_s: float = 0.15
    """Time constant of the smoothing, seconds."""


@dataclass(frozen=True)
class Config:
    """How a recording is registered."""

    initialization: Literal["votes", "middle"] = "votes"
    """votes: localized frames place the recording; middle: it starts in the middle of the room with the
    heading of its odometry, and is never rejected (the ablation without a localizer)."""
    odometry: Literal["device", "pictures"] = "device"
    """device: the recording's own poses if it has them; pictures: always RGB-D visual odometry."""
    vote: VoteConfig = field(default_factory=VoteConfig)
    """Single-frame localization."""
    alignment: AlignmentConfig = field(default_factory=AlignmentConfig)
    """All frames against the template."""
    gate: GateConfig = field(default_factory=GateConfig)
    """When a recording is accepted."""
    confidence: ConfidenceConfig = field(default_factory=ConfidenceConfig)
    """Confidence of the camera poses."""
    animal: bool = True
    """False: cameras only, for tables that compare only cameras."""
    root: RootConfig = field(default_factory=RootConfig)
    """The animal's root."""
    seed: int = 0
    """Seed of subsampling and calibration."""
