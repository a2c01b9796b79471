"""The stage: frames of all training recordings -> the feature basis."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from pipeline.backends.daisy import fit_basis
from pipeline.backends.descriptors import Describer
from pipeline.core import devices, progress
from pipeline.data import qa
from pipeline.data.clips import Clip
from pipeline.geometry.subsampling import evenly
from stages.fit_feature_basis.config import Config

Describe = Callable[[np.ndarray, int], np.ndarray]
FRAMES_PER_RECORDING = 16
"""Frames described per recording: a minute at one every four seconds, so that each recording counts alike."""
STRIDE_PX = 16
"""Distance between sampled descriptors, color pixels: about their own size, nearer ones repeat each
other."""
MIN_VARIANCE_PERCENT = 35.0
"""variance that 16 axes hold of DAISY on any textured room; noise and plain pictures hold less"""
MIN_DESCRIPTORS = 2000
"""a tenth of what four short recordings give"""


@dataclass(frozen=True)
class Inputs:
    """What the stage reads."""

    frames: Mapping[str, Path]
    """`frames/<id>` of every recording that models may learn from."""


def run(inputs: Inputs, config: Config, out: Path, *, device: devices.Device = "cpu") -> None:
    """Fit the 16 feature channels of one agent into `out`."""
    folders = progress.track(inputs.frames.values(), "feature basis: recordings")
    clips = [Clip.open(folder) for folder in folders]
    describer = Describer(config.backend, config.weights)
    descriptors = sample_descriptors(clips, describer.open(device))
    basis = fit_basis(descriptors)
    basis.save(out)
    describer.save(out)
    held_percent = 100 * float(basis.explained.sum())
    qa.write(
        out,
        good="the 16 axes hold most of the variance",
        bad="less than a third of it: the pictures are noise, or have no texture",
        checks=[
            qa.Check("variance held", held_percent, "%", warn=MIN_VARIANCE_PERCENT, better="higher"),
            qa.Check("descriptors", float(len(descriptors)), "", warn=MIN_DESCRIPTORS, better="higher"),
        ],
    )


def sample_descriptors(clips: Iterable[Clip], describe: Describe) -> Float[np.ndarray, "sample channel"]:
    """Describe `FRAMES_PER_RECORDING` frames of each recording, evenly spread in time."""
    shown = ((clip, evenly(len(clip), FRAMES_PER_RECORDING, rounded=True)) for clip in clips)
    described = (describe(clip.color(int(frame)), STRIDE_PX) for clip, frames in shown for frame in frames)
    return np.concatenate([raw.reshape(-1, raw.shape[-1]) for raw in described])
