"""The stage: frames of one recording and the basis -> features, and the quality page."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from pipeline.backends.daisy import FeatureBasis
from pipeline.backends.descriptors import Describer
from pipeline.core import devices, progress
from pipeline.data import features, plots, qa
from pipeline.data.clips import Clip
from pipeline.geometry import subsampling
from stages.extract_features.config import Config

SHOWN_FRAMES, HEIGHT_PX, GAIN = 6, 200, 220
"""Frames on the contact sheet, their height, and gray levels per unit of a channel."""


@dataclass(frozen=True)
class Inputs:
    """What the stage reads."""

    frames: Path
    """`frames/<id>` of the recording."""
    feature_basis: Path


def run(inputs: Inputs, config: Config, out: Path, *, device: devices.Device = "cpu") -> None:
    """Describe every frame of one recording, in the shared basis, into `out`."""
    clip, basis = Clip.open(inputs.frames), FeatureBasis.load(inputs.feature_basis)
    describe = Describer.load(inputs.feature_basis).open(device)
    with features.writer(out, len(clip), clip.color_size) as table:
        for frame in progress.track(range(len(clip)), "features: frames"):
            raw = describe(clip.color(frame), features.STRIDE_PX)
            table.append(features=basis.project(raw).astype(np.float16))
    report_quality(out, clip, features.open_features(out))


def report_quality(folder: Path, clip: Clip, described: Float[np.ndarray, "frame height width 16"]) -> None:
    """Write the quality page: the first three channels as colors, beside the pictures."""
    shown = subsampling.evenly(len(clip), SHOWN_FRAMES)
    size = (HEIGHT_PX, max(round(clip.color_size[1] * HEIGHT_PX / clip.color_size[0]), 1))
    colors = np.clip(128 + GAIN * described[shown][..., :3].astype(np.float32), 0, 255).astype(np.uint8)
    images = [*(clip.color(int(i)) for i in shown), *colors]
    sheet = plots.grid([plots.resized(image, size) for image in images], len(shown))
    pairs = (described[i : i + 2].astype(np.float32) for i in range(len(described) - 1))
    similarity = float(np.median([np.einsum("hwc,hwc->hw", *pair) for pair in pairs]))
    qa.write(
        folder,
        good="the same thing has the same color in all pictures and in all recordings",
        bad="colors flicker between neighboring pictures, or all is one color",
        checks=[qa.Check("cosine similarity of neighboring frames", similarity, "", 0.5, None, "higher")],
        pictures=[qa.Picture("features", sheet, "frames and their first three channels")],
    )
