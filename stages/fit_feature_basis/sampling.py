"""Draw descriptors evenly over recordings, whatever their length, for the joint basis."""

from collections.abc import Callable, Iterable

import numpy as np
from jaxtyping import Float

from pipeline.files.clips import Clip

Describe = Callable[[np.ndarray, int], np.ndarray]


def sample_descriptors(
    clips: Iterable[Clip], describe: Describe, *, frames_per_clip: int, stride_px: int
) -> Float[np.ndarray, "sample channel"]:
    """Describe ``frames_per_clip`` frames of each recording, evenly spread in time."""
    return np.concatenate([_of_clip(clip, describe, frames_per_clip, stride_px) for clip in clips])


def _of_clip(clip: Clip, describe: Describe, frames: int, stride_px: int) -> Float[np.ndarray, "sample channel"]:
    chosen = np.unique(np.linspace(0, len(clip) - 1, frames).round().astype(int))
    described = (describe(clip.color(int(frame)), stride_px) for frame in chosen)
    return np.concatenate([raw.reshape(-1, raw.shape[-1]) for raw in described])
