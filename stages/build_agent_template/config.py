"""Settings of the agent template."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Config:
    """Settings of the agent template."""

    seed: int = 0
    """of all randomness"""
    turn_deg: float = 0.0
    """rotation of the canonical axes, degrees, counterclockwise from above, where the report's turntable does
    not begin with the head: 180 where it begins with the tail, 90 or -90 with a side"""
    voxel_m: float = 0.008
    """cells of the fused volume, metres"""
    vertices: int = 3000
    """about how many vertices the surface has"""
    bones: int = 25
    """number of Gaussian bones"""
    views: int = 24
    """frames whose colors and features are averaged"""
