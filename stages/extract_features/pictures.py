"""The quality page of the features: the first three channels as colours, beside the pictures."""

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from pipeline import qa
from pipeline.files.clips import Clip

SHOWN_FRAMES = 6
HEIGHT_PX = 200


def report_quality(folder: Path, clip: Clip, features: Float[np.ndarray, "frame height width 16"]) -> None:
    """Write the stage's own judgement."""
    shown = np.unique(np.linspace(0, len(clip) - 1, SHOWN_FRAMES).astype(int))
    width_px = max(round(clip.color_size[1] * HEIGHT_PX / clip.color_size[0]), 1)
    columns = [np.concatenate([_resized(clip.color(int(i)), width_px), _resized(as_colors(features[i]), width_px)]) for i in shown]
    steady = [np.einsum("hwc,hwc->hw", *features[i : i + 2].astype(np.float32)) for i in range(len(features) - 1)]
    qa.write(
        folder,
        good="the same thing has the same colour in all pictures and in all recordings",
        bad="colours flicker between neighbouring pictures, or all is one colour",
        checks=[qa.Check("likeness of neighbouring frames", float(np.median(steady)), "", warn=0.5, better="higher")],
        pictures=[qa.Picture("features", np.concatenate(columns, axis=1), "frames and their first three channels")],
    )


def as_colors(features: Float[np.ndarray, "height width 16"]) -> UInt8[np.ndarray, "height width 3"]:
    """Show the first three channels; the same mapping for all recordings of an agent."""
    return np.clip(128 + 220 * features[..., :3].astype(np.float32), 0, 255).astype(np.uint8)


def _resized(image: UInt8[np.ndarray, "height width 3"], width_px: int) -> UInt8[np.ndarray, "200 width 3"]:
    """Bring a picture and its features, which leave out what is no whole cell of it, to one size."""
    return cv2.resize(image, (width_px, HEIGHT_PX), interpolation=cv2.INTER_AREA)
