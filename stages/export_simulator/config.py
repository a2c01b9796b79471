"""Settings of `stages.export_simulator`."""

from dataclasses import dataclass
from typing import Literal

Layout = Literal["file", "folder"]


@dataclass(frozen=True)
class Config:
    """What the page calls the animal, and how light it has to be."""

    name: str = "the animal"
    """what the page calls it"""
    scene_faces: int = 40_000
    """triangles kept of the scene"""
    agent_faces: int = 12_000
    """triangles kept of the animal"""
    scene_splats: int = 150_000
    """Gaussians kept of the scene, the faintest go first"""
    agent_splats: int = 20_000
    """Gaussians kept of the animal"""
    layout: Layout = "file"
    """one page that opens from the disk, or a folder for big scenes that needs a static host"""
