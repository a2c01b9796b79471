"""Reading what `reconstruct` promises to the behaviour models."""

from pathlib import Path

import numpy as np

from pipeline.files import arrays
from stages.slice_behavior.gridding import Motion


def read_motion(folder: Path) -> Motion:
    """Read the motion of one recording. Raises InputError ART-010 when damaged."""
    names = ("timestamp_s", "world_from_camera", "world_from_agent", "agent_from_bone", "confidence")
    loaded = arrays.load(folder / "motion.npz", names)
    return Motion(*(np.asarray(loaded[name], np.float64) for name in names))
