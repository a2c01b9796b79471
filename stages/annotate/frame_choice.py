"""Pick frames to click in: spread over a recording, the sharpest of each stretch."""

import numpy as np
from jaxtyping import Bool, Float


def sharpest_per_stretch(
    quality: Float[np.ndarray, "frame"], count: int, usable: Bool[np.ndarray, "frame"] | None = None
) -> list[int]:
    """Return up to ``count`` frames in order: the best usable one of each of as many equal intervals."""
    usable = np.ones(len(quality), bool) if usable is None else usable
    found = []
    for stretch in np.array_split(np.arange(len(quality)), min(count, len(quality))):
        stretch = stretch[usable[stretch]]
        if len(stretch):
            found.append(int(stretch[np.argmax(quality[stretch])]))
    return found
