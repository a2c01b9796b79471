"""Settings of the feature basis."""

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class Config:
    """Which descriptor all features of an agent are made of."""

    backend: Literal["daisy", "dinov2"] = "daisy"
    """`daisy` needs no weights, `dinov2` needs `make extras` and a checkpoint."""
    weights: str = ""
    """Folder of the checkpoint (`facebook/dinov2-small` and its like)."""
