"""Standard files of 3D Gaussians."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from pipeline.data import gaussian_ply
from pipeline.fields.gaussians import OPACITY, ROTATION, load_ply
from stages.export.writing import ExportRecord


def write(folder: Path, clouds: dict[str, Float[np.ndarray, "point 62"]]) -> ExportRecord:
    """Write `scene.ply` (world frame) and `agent.ply` (agent frame, at rest) without invisible rows."""
    for name, rows in clouds.items():
        opacity = 1 / (1 + np.exp(-rows[:, OPACITY].astype(np.float64)))
        valid = rows[np.isfinite(rows).all(1) & (opacity >= 1 / 255)].copy()
        valid[:, ROTATION] /= np.linalg.norm(valid[:, ROTATION], axis=1, keepdims=True)
        gaussian_ply.write(folder / f"{name}.ply", valid)
        assert len(load_ply(folder / f"{name}.ply")) == len(valid)
    reader = "the project's own reader; the layout is that of the 3DGS reference viewer"
    return ExportRecord("own writer", {}, reader, "meters, +y up")
