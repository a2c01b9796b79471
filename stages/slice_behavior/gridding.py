"""Motion at the recording's own times becomes a trajectory on an even time grid, honest about its gaps."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from pipeline.behavior.trajectories import RATE_HZ, Trajectory
from pipeline.geometry import rigid


@dataclass(frozen=True)
class ReconstructedMotion:
    """The reconstructed motion of one recording, as in `reconstruction/<id>/motion.npz`."""

    timestamp_s: Float[np.ndarray, "frame"]
    world_from_camera: Float[np.ndarray, "frame 4 4"]
    world_from_agent: Float[np.ndarray, "frame 4 4"]
    agent_from_bone: Float[np.ndarray, "frame bone 4 4"]
    confidence: Float[np.ndarray, "frame"]
    agent_visible: Bool[np.ndarray, "frame"]


def trajectory_from_motion(
    motion: ReconstructedMotion, *, min_confidence: float, max_gap_s: float, smooth_s: float
) -> Trajectory:
    """Resample to 10 Hz. A grid time is valid where trusted frames no more than ``max_gap_s`` apart enclose
    it.

    Trusted are those that show the agent from a camera whose pose is known.

    Invalid times hold the nearest trusted motion, so that every number is finite. ``smooth_s`` is the
    standard deviation of a Gaussian in time that takes the jitter out of the agent's root.
    """
    finite = np.isfinite(motion.world_from_agent).all((1, 2)) & np.isfinite(motion.agent_from_bone).all(
        (1, 2, 3)
    )
    camera_known = np.isfinite(motion.world_from_camera).all((1, 2)) & (motion.confidence >= min_confidence)
    trusted = finite & camera_known & motion.agent_visible
    time = motion.timestamp_s
    grid = np.arange(np.floor(time[-1] * RATE_HZ + 1e-6) + 1) / RATE_HZ
    grid = grid[grid >= time[0] - 0.5 / RATE_HZ]
    bones = motion.agent_from_bone.shape[1]
    if not trusted.any():
        still = np.broadcast_to(np.eye(4), (len(grid), 4, 4))
        rest = np.broadcast_to(np.eye(4, dtype=np.float32), (len(grid), bones, 4, 4))
        return Trajectory(grid, still.copy(), rest.copy(), still.copy(), np.zeros(len(grid), bool))
    good = time[trusted]
    agent = rigid.smoothed(
        rigid.interpolate(good, motion.world_from_agent[trusted], grid), smooth_s * RATE_HZ
    )
    bone = [rigid.interpolate(good, motion.agent_from_bone[trusted, b], grid) for b in range(bones)]
    camera = rigid.interpolate(good, motion.world_from_camera[trusted], grid)
    return Trajectory(
        grid, agent, np.stack(bone, 1).astype(np.float32), camera, within_short_gaps(good, grid, max_gap_s)
    )


def within_short_gaps(
    good: Float[np.ndarray, "frame"], grid: Float[np.ndarray, "sample"], max_gap_s: float
) -> Bool[np.ndarray, "sample"]:
    """Tell which grid times lie between (or within half a grid step of) good times at most ``max_gap_s``
    apart.
    """
    near = 0.5 / RATE_HZ
    after = np.searchsorted(good, grid, side="left").clip(0, len(good) - 1)
    before = (np.searchsorted(good, grid, side="right") - 1).clip(0)
    on_frame = np.minimum(np.abs(good[after] - grid), np.abs(good[before] - grid)) <= near
    between = (good[before] <= grid) & (grid <= good[after]) & (good[after] - good[before] <= max_gap_s)
    return on_frame | between
