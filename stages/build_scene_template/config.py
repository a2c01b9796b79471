"""Settings of the scene template."""

from dataclasses import dataclass, field


@dataclass(frozen=True)
class SfmConfig:
    """How keyframes are chosen and matched."""

    max_keyframes: int = 90
    """Upper bound; keyframe spacing is increased until it holds."""
    features: int = 1500
    """SIFT features per keyframe."""
    overlap: int = 6
    """Following keyframes that each keyframe is matched with."""
    loops_per_keyframe: int = 4
    """Loop closure candidates per keyframe, at most."""


@dataclass(frozen=True)
class RefinementConfig:
    """How keyframe poses are optimized jointly."""

    neighbours: int = 8
    """Keyframes that each keyframe's depth is compared with."""
    rounds: int = 10
    """Gauss-Newton steps of the keyframe graph."""


@dataclass(frozen=True)
class FusionConfig:
    """Resolution and reach of the depth fusion."""

    voxel_m: float = 0.025
    """Edge of a voxel, meters."""
    truncation_m: float = 0.1
    """Truncation of the signed distance, meters; about three times the depth noise at the far end."""
    furthest_m: float = 4.5
    """Depth beyond this is not fused, meters."""
    island_faces: int = 120
    """Smaller connected components are removed, faces."""
    align_rounds: int = 4
    """Gauss-Newton steps that align every frame to the surface."""
    align_stride_px: int = 9
    """Grid spacing of the depth pixels in that alignment."""
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
    """Use the mesh that comes with the recording (Polycam's) if its depth confirms it."""
    seed: int = 0
    """Seed of COLMAP and RANSAC."""
