"""The stage: frames of one recording and the basis -> features."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pipeline.backends.daisy import FeatureBasis
from pipeline.backends.descriptors import Describer
from pipeline.core import devices, progress
from pipeline.data import features
from pipeline.data.clips import Clip
from stages.extract_features import pictures
from stages.extract_features.config import Config


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
    pictures.report_quality(out, clip, features.open_features(out))
