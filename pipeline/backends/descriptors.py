"""Which descriptor an agent's features are made of: one choice, beside the basis that was fitted to it."""

import json
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal, assert_never

import numpy as np
from jaxtyping import Float, UInt8

from pipeline.backends import daisy

Backend = Literal["daisy", "dinov2"]
FILE = "describer.json"


@dataclass(frozen=True)
class Describer:
    """A descriptor and its weights."""

    backend: Backend = "daisy"
    weights: str = ""
    """folder of a checkpoint; empty for `daisy`, which has none"""

    @classmethod
    def load(cls, folder: Path) -> "Describer":
        """Read what a finished ``feature_basis`` was fitted to."""
        return cls(**json.loads((folder / FILE).read_text()))

    def save(self, folder: Path) -> None:
        """Write ``describer.json``."""
        (folder / FILE).write_text(json.dumps(asdict(self)) + "\n")

    def open(
        self, device: str
    ) -> Callable[[UInt8[np.ndarray, "height width 3"], int], Float[np.ndarray, "rows columns channel"]]:
        """Return ``describe(color, stride_px)``: descriptors of unit length at cells of ``stride_px``."""
        match self.backend:
            case "daisy":
                return daisy.describe
            case "dinov2":
                from pipeline.backends.dinov2 import Dinov2

                return Dinov2(self.weights, device).describe
            case _:
                assert_never(self.backend)
