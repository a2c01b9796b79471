"""Motion of one recording, independent of its file format."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from pipeline.behavior.perception import FeatureVolume
from pipeline.behavior.trajectories import ABSENT_M

CLIP_GAP_S = 5.0
"""Gap between two clips of one recording, so that no window spans them."""

STEP_TOLERANCE = 1e-3
"""Tolerance of gaps for rounded times, as a share of a step."""


@dataclass(frozen=True)
class MeasuredMotion:
    """Poses of agent and observer at the recording's own times, and the scene around them."""

    timestamp_s: Float[np.ndarray, "frame"]
    world_from_agent: Float[np.ndarray, "frame 4 4"]
    agent_from_bone: Float[np.ndarray, "frame bone 4 4"]
    world_from_camera: Float[np.ndarray, "frame 4 4"]
    agent_from_bone_rest: Float[np.ndarray, "bone 4 4"]
    volume: FeatureVolume
    companions: Float[np.ndarray, "frame companion 4"] | None = None
    """others besides the observer: world position, and kind as index into `KINDS`; NaN where absent"""

    def arrays(self) -> dict[str, Float[np.ndarray, "..."] | Bool[np.ndarray, "frame"]]:
        """Return the arrays of a ``motion.npz``."""
        known = np.all(np.isfinite(self.world_from_agent), axis=(1, 2))
        return {
            "timestamp_s": self.timestamp_s.astype("f8"),
            "world_from_camera": self.world_from_camera.astype("f8"),
            "world_from_agent": self.world_from_agent.astype("f8"),
            "agent_from_bone": self.agent_from_bone.astype("f4"),
            "confidence": known.astype("f4"),
            "agent_visible": known,
        } | ({} if self.companions is None else {"companions": self.companions.astype("f4")})


def absent_observer(frames: int) -> Float[np.ndarray, "frame 4 4"]:
    """Return the poses of an absent observer."""
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, 0, 3] = ABSENT_M
    return poses


def concatenated_times(times: list[Float[np.ndarray, "_"]]) -> Float[np.ndarray, "frame"]:
    """Put clips on one clock, in order, far enough apart: by a whole number of their steps, so that a grid of
    the same rate holds the times of all clips and nothing between two frames is asked for.
    """
    placed, begin = [], 0.0
    for time in times:
        placed.append(time - time[0] + begin)
        step_s = float(np.median(np.diff(time))) if len(time) > 1 else CLIP_GAP_S
        begin = placed[-1][-1] + np.ceil(CLIP_GAP_S / step_s - STEP_TOLERANCE) * step_s
    return np.concatenate(placed)
