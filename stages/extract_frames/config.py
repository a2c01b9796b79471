"""Settings of frame extraction."""

from dataclasses import dataclass, field


@dataclass(frozen=True)
class PhotogrammetryConfig:
    """How a walk-through without depth is mapped from its pictures."""

    keyframe_share: float = 0.06
    """A keyframe follows the last one when the picture has moved by this share of its width."""
    max_keyframes: int = 120
    """Upper bound on keyframes; steps are widened until it holds."""
    features: int = 2000
    """SIFT features kept per keyframe."""
    overlap: int = 8
    """Keyframes matched with this many successors."""
    retrieved: int = 8
    """Further keyframes matched with each one: those that share the most visual words."""
    focal_share: float = 0.85
    """Focal length that calibration begins from, share of the picture's longer side."""
    depth_side_px: int = 224
    """Longer side of the depth pictures, pixels."""
    depth_planes: int = 112
    """Planes of the depth sweep, evenly spaced in inverse depth."""
    depth_sources: int = 6
    """Pictures that each one is compared with in the depth sweep."""


@dataclass(frozen=True)
class Config:
    """Settings of frame extraction."""

    rate_hz: float = 10.0
    """Frames per second to keep; gaps in the recording stay gaps."""
    max_side_px: int = 640
    """Larger pictures are divided by a whole number until their longer side fits, pixels."""
    max_depth_m: float = 6.0
    """Depth beyond this is unknown, meters; phone LiDAR reaches about 5."""
    min_depth_valid: float = 0.2
    """Frames with a smaller share (0..1) of known depth are left out."""
    jpeg_quality: int = 95
    """JPEG quality 1..100 of pictures that were rotated or reduced; the others keep the phone's bytes."""
    without_depth: PhotogrammetryConfig = field(default_factory=PhotogrammetryConfig)
    """How a walk-through without depth is mapped."""
