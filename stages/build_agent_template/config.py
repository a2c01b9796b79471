"""Settings of the agent template."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Config:
    """Settings of the agent template."""

    seed: int = 0
    """seed of the random numbers"""
    turn_deg: float = 0.0
    """correction of the heading, degrees, counterclockwise from above, if the report's turntable does not
    begin with the head: 180 if it begins with the tail, 90 or -90 with a side"""
    voxel_m: float = 0.008
    """voxel edge of the fused volume, meters"""
    vertices: int = 3000
    """approximate number of vertices of the surface"""
    bones: int = 25
    """number of Gaussian bones"""
    views: int = 24
    """number of frames whose colors and features are averaged"""
