"""Where a phone's odometry is torn: tracking was lost and found again elsewhere, a step that no hand makes.

`torn` tells such steps, `mended` chains the odometry without them, so that nothing after them is displaced.
"""

import numpy as np
import scipy.ndimage
from jaxtyping import Bool, Float

from pipeline.space import rigid

MOST_M_S = 4.0
"""a step that is so much faster than the steps around it is none of the phone's"""
AROUND = 5
"""steps whose median tells how fast the phone moves"""
SHORTEST_S = 0.05
"""frames are taken to be at least so far apart: noise over less is no speed"""


def torn(timestamp_s: Float[np.ndarray, "frame"], odometry_from_camera: Float[np.ndarray, "frame 4 4"]) -> Bool[np.ndarray, "frame"]:
    """Tell which frames cannot be where odometry says after the frame before them; False for the first.

    Turns do not tell: a phone that is tipped over turns as fast as one whose tracking jumps.
    """
    if len(timestamp_s) < 2:
        return np.zeros(len(timestamp_s), bool)
    step_m = np.linalg.norm(np.diff(odometry_from_camera[:, :3, 3], axis=0), axis=1)
    speed = step_m / np.maximum(np.diff(timestamp_s), SHORTEST_S)
    usual = scipy.ndimage.median_filter(speed, AROUND, mode="mirror")
    return np.concatenate([[False], speed - usual > MOST_M_S])


def mended(
    timestamp_s: Float[np.ndarray, "frame"], odometry_from_camera: Float[np.ndarray, "frame 4 4"], torn: Bool[np.ndarray, "frame"]
) -> Float[np.ndarray, "frame 4 4"]:
    """Chain odometry anew, as fast over each tear as before and after it; whole odometry is returned as it is."""
    if not torn.any():
        return odometry_from_camera
    step, gap_s = rigid.inverse(odometry_from_camera[:-1]) @ odometry_from_camera[1:], np.diff(timestamp_s)[:, None]
    over, whole = np.flatnonzero(torn[1:]), np.flatnonzero(~torn[1:])
    rate = rigid.log(step[whole]) / np.maximum(gap_s[whole], SHORTEST_S)
    step[over] = rigid.exp(gap_s[over] * np.stack([np.interp(over, whole, axis) for axis in rate.T], axis=1))
    poses = [odometry_from_camera[0]]
    for first_from_second in step:
        poses.append(poses[-1] @ first_from_second)
    return np.stack(poses)
