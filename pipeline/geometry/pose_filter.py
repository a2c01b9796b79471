"""A Wiener filter of sequences of poses, whose noise is measured where they change least."""

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import uniform_filter1d

from pipeline.geometry import rigid

CALM_SHARE = 0.2
"""the calmest share of frames, whose variance is noise: animals rest, people stand"""


def wiener_filter(
    poses: Float[np.ndarray, "frame *pose 4 4"], known: Bool[np.ndarray, "frame"], window: int
) -> Float[np.ndarray, "frame *pose 4 4"]:
    """Filter each sequence of poses, rotation and translation by themselves (Lee 1980).

    A pose is moved to the mean over ``window`` frames, by as much of its deviation as noise explains: all of
    it where the local variance is that of noise, hardly any in fast motion. Noise is the `CALM_SHARE`
    quantile of the local variance of ``known`` frames. With fewer of them than the window, poses are returned
    unchanged.
    """
    if known.sum() < window:
        return poses
    mean = uniform_filter1d(poses, window, axis=0, mode="nearest")
    mean[..., :3, :3] = rigid.nearest_rotation(mean[..., :3, :3])
    turned = np.swapaxes(mean[..., :3, :3], -1, -2) @ poses[..., :3, :3]
    shift = poses[..., :3, 3] - mean[..., :3, 3]
    turn = _signal(rigid.log(rigid.make(turned, shift))[..., :3], known, window)
    moved = rigid.exp(np.concatenate([turn, _signal(shift, known, window)], axis=-1))
    rotation = mean[..., :3, :3] @ moved[..., :3, :3]
    return rigid.make(rotation, mean[..., :3, 3] + moved[..., :3, 3])


def _signal(
    deviation: Float[np.ndarray, "frame *pose 3"], known: Bool[np.ndarray, "frame"], window: int
) -> Float[np.ndarray, "frame *pose 3"]:
    """Return the part of deviations that is not noise."""
    variance = uniform_filter1d(np.square(deviation).sum(-1), window, axis=0, mode="nearest")
    noise = np.quantile(variance[known], CALM_SHARE, axis=0)
    share = 1 - noise / np.maximum(variance, np.maximum(noise, np.finfo(float).tiny))
    return share[..., None] * deviation
