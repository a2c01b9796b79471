"""Settings of flow estimation."""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Config:
    """How flow is estimated."""

    backend: Literal["search", "raft"] = "search"
    """Dense inverse search without weights, or RAFT with its authors' weights."""
    weights: str = "raft-things.pth"
    """RAFT's weights."""
    working_side_px: int = 1280
    """Pictures with a longer side are reduced to this one, pixels; reducing further is faster and blurs
    outlines."""
