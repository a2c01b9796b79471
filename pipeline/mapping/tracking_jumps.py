"""Tracking jumps in a device's odometry: tracking was lost and resumed elsewhere, a step no hand can make.

`find_jumps` detects such steps; `repair` chains the odometry without them, so that nothing after them is
displaced.
"""

import numpy as np
import scipy.ndimage
from jaxtyping import Bool, Float

from pipeline.geometry import rigid

JUMP_M_S = 4.0
"""A step faster than its neighbours by more than this, m/s, is a jump: hands reach about 2 m/s."""
WINDOW_STEPS = 5
"""Steps whose median is the usual speed."""
SHORTEST_S = 0.05
"""Least time between frames, seconds: noise over less is no speed."""


def find_jumps(
    timestamp_s: Float[np.ndarray, "frame"], odometry_from_camera: Float[np.ndarray, "frame 4 4"]
) -> Bool[np.ndarray, "frame"]:
    """Return which frames cannot be where odometry places them after the frame before; False for the first.

    Only translation counts: a phone that is tipped over turns as fast as one whose tracking jumps.
    """
    if len(timestamp_s) < 2:
        return np.zeros(len(timestamp_s), bool)
    step_m = np.linalg.norm(np.diff(odometry_from_camera[:, :3, 3], axis=0), axis=1)
    speed = step_m / np.maximum(np.diff(timestamp_s), SHORTEST_S)
    usual = scipy.ndimage.median_filter(speed, WINDOW_STEPS, mode="mirror")
    return np.concatenate([[False], speed - usual > JUMP_M_S])


def repair(
    timestamp_s: Float[np.ndarray, "frame"],
    odometry_from_camera: Float[np.ndarray, "frame 4 4"],
    jumps: Bool[np.ndarray, "frame"],
) -> Float[np.ndarray, "frame 4 4"]:
    """Chain odometry anew, each jump replaced by the velocity around it; unbroken odometry is returned as it
    is."""
    if not jumps.any():
        return odometry_from_camera
    step = rigid.inverse(odometry_from_camera[:-1]) @ odometry_from_camera[1:]
    gap_s = np.diff(timestamp_s)[:, None]
    broken, intact = np.flatnonzero(jumps[1:]), np.flatnonzero(~jumps[1:])
    rate = rigid.log(step[intact]) / np.maximum(gap_s[intact], SHORTEST_S)
    step[broken] = rigid.exp(
        gap_s[broken] * np.stack([np.interp(broken, intact, axis) for axis in rate.T], axis=1)
    )
    return rigid.accumulate(step, odometry_from_camera[0])
