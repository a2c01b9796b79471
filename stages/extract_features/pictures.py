"""The quality page of the features: the first three channels as colors, beside the pictures."""

from pathlib import Path

import numpy as np
from jaxtyping import Float

from pipeline.data import plots, qa
from pipeline.data.clips import Clip
from pipeline.geometry import subsampling

SHOWN_FRAMES = 6
HEIGHT_PX = 200


def report_quality(folder: Path, clip: Clip, features: Float[np.ndarray, "frame height width 16"]) -> None:
    """Write the stage's own judgment."""
    shown = subsampling.evenly(len(clip), SHOWN_FRAMES)
    size = (HEIGHT_PX, max(round(clip.color_size[1] * HEIGHT_PX / clip.color_size[0]), 1))
    colors = np.clip(128 + 220 * features[shown][..., :3].astype(np.float32), 0, 255).astype(np.uint8)
    images = [*(clip.color(int(i)) for i in shown), *colors]
    sheet = plots.grid([plots.resized(image, size) for image in images], len(shown))
    pairs = (features[i : i + 2].astype(np.float32) for i in range(len(features) - 1))
    steady = [np.einsum("hwc,hwc->hw", *pair) for pair in pairs]
    similarity = float(np.median(steady))
    qa.write(
        folder,
        good="the same thing has the same color in all pictures and in all recordings",
        bad="colors flicker between neighboring pictures, or all is one color",
        checks=[qa.Check("cosine similarity of neighboring frames", similarity, "", 0.5, None, "higher")],
        pictures=[qa.Picture("features", sheet, "frames and their first three channels")],
    )
