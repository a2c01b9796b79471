"""Turn recorded motion into animation: the longest sound stretch of each session, resampled to even keys."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float

from pipeline.data.glb import Action
from pipeline.geometry.subsampling import runs


@dataclass(frozen=True)
class SessionClip:
    """One session: the agent and its observer in the world, every frame valid."""

    name: str
    timestamp_s: Float[np.ndarray, " frame"]
    world_from_agent: Float[np.ndarray, "frame 4 4"]
    agent_from_bone: Float[np.ndarray, "frame bone 4 4"]
    world_from_camera: Float[np.ndarray, "frame 4 4"]
    begin_s: float = 0.0
    """when it begins in its session"""


def longest_run(valid: Bool[np.ndarray, " frame"]) -> slice:
    """Return the longest stretch of true frames (the first of equals; empty when there is none)."""
    return slice(*max(runs(valid).tolist(), key=lambda run: run[1] - run[0], default=(0, 0)))


def cut(motion: SessionClip, frames: slice) -> SessionClip:
    """Keep some frames and let time start at zero."""
    timestamp_s = motion.timestamp_s[frames]
    return replace(
        motion,
        timestamp_s=timestamp_s - timestamp_s[0],
        world_from_agent=motion.world_from_agent[frames],
        agent_from_bone=motion.agent_from_bone[frames],
        world_from_camera=motion.world_from_camera[frames],
        begin_s=float(timestamp_s[0]),
    )


def animation(motion: SessionClip, rate_hz: float) -> Action:
    """Resample to even keys from the first to the last frame: rotations by slerp, translations linearly."""
    poses = motion.world_from_agent, motion.agent_from_bone
    return Action(motion.name, motion.timestamp_s, *poses).resampled(rate_hz)
