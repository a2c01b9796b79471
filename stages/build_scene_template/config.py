"""Settings of the scene template."""

from dataclasses import dataclass, field


@dataclass(frozen=True)
class SfmConfig:
    """How keyframes are chosen and matched."""

    max_keyframes: int = 90
    """Upper bound; steps are widened until it holds."""
    features: int = 1500
    """SIFT features per keyframe."""
    overlap: int = 6
    """Successors that each keyframe is matched with."""
    loops_per_keyframe: int = 4
    """Loop closure candidates per keyframe, at most."""


@dataclass(frozen=True)
class RefinementConfig:
    """How keyframes are optimized against each other."""

    neighbours: int = 8
    """Keyframes that each keyframe's depth is compared with."""
    rounds: int = 10
    """Gauss-Newton steps of the keyframe graph."""


@dataclass(frozen=True)
class FusionConfig:
    """Resolution and reach of the depth fusion."""

    voxel_m: float = 0.025
    """Edge of a voxel, metres."""
    truncation_m: float = 0.1
    """Truncation of the signed distance, metres; about three times the depth noise at the far end."""
    furthest_m: float = 4.5
    """Depth beyond this is not fused, metres."""
    island_faces: int = 120
    """Smaller separate pieces of surface are dropped, faces."""
    align_rounds: int = 4
    """Gauss-Newton steps that align every frame to the surface."""
    align_stride_px: int = 9
    """One depth pixel in so many, each way, takes part in that alignment."""
    feature_frames: int = 80
    """Frames whose features are averaged on the vertices, evenly spaced."""


@dataclass(frozen=True)
class Config:
    """How the scene template is built."""

    sfm: SfmConfig = field(default_factory=SfmConfig)
    """Keyframes and structure from motion."""
    refinement: RefinementConfig = field(default_factory=RefinementConfig)
    """Keyframe poses by tracks, depth and odometry."""
    fusion: FusionConfig = field(default_factory=FusionConfig)
    """Depth fusion."""
    own_mesh: bool = True
    """Use a mesh that the recording brings along (Polycam's) where its depth confirms it."""
    seed: int = 0
    """Seed of COLMAP and RANSAC."""
