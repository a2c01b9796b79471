"""Resampling of motion to a trajectory on a regular time grid, with gaps marked invalid."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from pipeline.behavior.trajectories import RATE_HZ, Trajectory
from pipeline.data.motion import Motion
from pipeline.geometry import rigid, subsampling


@dataclass(frozen=True)
class ReconstructedMotion(Motion):
    """The reconstructed motion of one recording, and of those beside its animal."""

    companions: Float[np.ndarray, "frame companion 4"] | None = None
    """others beside the observer, as in a `Trajectory`"""


def trajectory_from_motion(
    motion: ReconstructedMotion,
    *,
    min_confidence: float,
    max_gap_s: float,
    smooth_s: float,
    rate_hz: float = RATE_HZ,
) -> Trajectory:
    """Resample motion to a regular rate.

    Times are valid between trusted frames at most ``max_gap_s`` apart; trusted frames show the agent from a
    camera of known pose. Invalid times hold the nearest trusted motion, so that all numbers are finite. The
    agent's root is smoothed by a Gaussian in time with standard deviation ``smooth_s``.
    """
    finite = np.isfinite(motion.world_from_agent).all((1, 2))
    finite &= np.isfinite(motion.agent_from_bone).all((1, 2, 3))
    camera_known = np.isfinite(motion.world_from_camera).all((1, 2)) & (motion.confidence >= min_confidence)
    trusted = finite & camera_known & motion.agent_visible
    time = motion.timestamp_s
    grid = np.arange(np.floor(time[-1] * rate_hz + 1e-6) + 1) / rate_hz
    grid = grid[grid >= time[0] - 0.5 / rate_hz]
    companions = motion.companions
    if companions is not None:
        companions = resampled(time, companions, grid, max_gap_s, rate_hz)
    if not trusted.any():
        still = np.broadcast_to(np.eye(4), (len(grid), 4, 4))
        rest = np.broadcast_to(np.eye(4, dtype=np.float32), (len(grid), *motion.agent_from_bone.shape[1:]))
        invalid = np.zeros(len(grid), bool)
        return Trajectory(grid, still.copy(), rest.copy(), still.copy(), invalid, companions)
    good = time[trusted]
    body = motion.world_from_agent[trusted], motion.agent_from_bone[trusted]
    agent, bones = rigid.interpolate_body(good, *body, grid)
    agent = rigid.smoothed(agent, smooth_s * rate_hz)
    camera = rigid.interpolate(good, motion.world_from_camera[trusted], grid)
    valid = subsampling.within_short_gaps(good, grid, max_gap_s, 0.5 / rate_hz)
    return Trajectory(grid, agent, bones.astype(np.float32), camera, valid, companions)


def resampled(
    time: Float[np.ndarray, "frame"],
    companions: Float[np.ndarray, "frame companion 4"],
    grid: Float[np.ndarray, "sample"],
    max_gap_s: float,
    rate_hz: float,
) -> Float[np.ndarray, "sample companion 4"]:
    """Resample companions; NaN at times not between known frames at most ``max_gap_s`` apart."""
    found = np.full((len(grid), *companions.shape[1:]), np.nan, np.float32)
    for number in range(companions.shape[1]):
        known = np.isfinite(companions[:, number]).all(-1)
        if known.any():
            here = subsampling.within_short_gaps(time[known], grid, max_gap_s, 0.5 / rate_hz)
            track = companions[known, number]
            for channel in range(track.shape[1]):
                found[here, number, channel] = np.interp(grid[here], time[known], track[:, channel])
    return found
