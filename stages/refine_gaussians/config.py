"""Settings of the Gaussian refinement."""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class GaussianCounts:
    """Numbers of Gaussians."""

    scene: int = 100_000
    """of the scene"""
    agent: int = 5_000
    """of the agent"""


@dataclass(frozen=True)
class GaussianWeights:
    """Weight of each loss."""

    color: float = 1.0
    """absolute difference of colors 0..1"""
    depth: float = 0.3
    """absolute difference of depth in units of 0.2 m, at most 1"""
    silhouette: float = 0.3
    """absolute difference of the agent's coverage and its mask"""
    flow: float = 0.05
    """difference of flow in rendered pixels, at most 4"""
    motion: float = 1.0
    """squared corrections of root and bones, in units of 0.1 m and 0.1 rad"""


@dataclass(frozen=True)
class Config:
    """Settings of the Gaussian refinement."""

    seed: int = 0
    """of all randomness"""
    steps: int = 1000
    """number of frames rendered, over all processes"""
    counts: GaussianCounts = GaussianCounts()
    """numbers of Gaussians"""
    cover_frames: int = 240
    """pictures, over all videos, from which colors and density of the initial Gaussians are computed"""
    long_side_px: int = 192
    """longer side of rendered pictures, pixels"""
    weights: GaussianWeights = GaussianWeights()
    """of the losses"""
    save_every: int = 200
    """steps between checkpoints"""
    backend: Literal["auto", "tiles", "gsplat"] = "auto"
    """rasterizer; auto: gsplat on CUDA if it is installed, otherwise tiles, which run on the CPU"""
