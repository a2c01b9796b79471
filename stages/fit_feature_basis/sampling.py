"""Draw descriptors evenly over recordings, whatever their length, for the joint basis."""

from collections.abc import Callable, Iterable

import numpy as np
from jaxtyping import Float

from pipeline.data.clips import Clip
from pipeline.geometry.subsampling import evenly

Describe = Callable[[np.ndarray, int], np.ndarray]
FRAMES_PER_RECORDING = 16
"""Frames described per recording: a minute at one every four seconds, so that each recording counts alike."""
STRIDE_PX = 16
"""Distance between sampled descriptors, color pixels: about their own size, nearer ones repeat each
other."""


def sample_descriptors(clips: Iterable[Clip], describe: Describe) -> Float[np.ndarray, "sample channel"]:
    """Describe `FRAMES_PER_RECORDING` frames of each recording, evenly spread in time."""
    shown = ((clip, evenly(len(clip), FRAMES_PER_RECORDING, rounded=True)) for clip in clips)
    described = (describe(clip.color(int(frame)), STRIDE_PX) for clip, frames in shown for frame in frames)
    return np.concatenate([raw.reshape(-1, raw.shape[-1]) for raw in described])
