"""Turn recorded motion into animation: the longest sound stretch of each session, resampled to even keys."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from pipeline.geometry import rigid


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
    edges = np.flatnonzero(np.diff(np.concatenate([[False], valid, [False]]).astype(np.int8)))
    starts, ends = edges[::2], edges[1::2]
    if len(starts) == 0:
        return slice(0, 0)
    longest = int(np.argmax(ends - starts))
    return slice(int(starts[longest]), int(ends[longest]))


def cut(motion: SessionClip, frames: slice) -> SessionClip:
    """Keep some frames and let time start at zero."""
    timestamp_s = motion.timestamp_s[frames]
    return SessionClip(
        motion.name,
        timestamp_s - timestamp_s[0],
        motion.world_from_agent[frames],
        motion.agent_from_bone[frames],
        motion.world_from_camera[frames],
        float(timestamp_s[0]),
    )


def resample(motion: SessionClip, rate_hz: float) -> SessionClip:
    """Resample to even keys from the first to the last frame: slerp for rotations, linear for
    translations.
    """
    count = int(np.floor((motion.timestamp_s[-1] - motion.timestamp_s[0]) * rate_hz + 1e-6)) + 1
    query_s = motion.timestamp_s[0] + np.arange(count) / rate_hz

    def at(a_from_b: np.ndarray) -> np.ndarray:
        return rigid.interpolate(motion.timestamp_s, a_from_b, query_s)

    bones = [at(motion.agent_from_bone[:, bone]) for bone in range(motion.agent_from_bone.shape[1])]
    return SessionClip(
        motion.name,
        query_s - query_s[0],
        at(motion.world_from_agent),
        np.stack(bones, 1),
        at(motion.world_from_camera),
    )
