"""The stage: frames of all training recordings -> the feature basis."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from pipeline.backends.daisy import fit_basis
from pipeline.backends.descriptors import Describer
from pipeline.core import devices, progress
from pipeline.data import qa
from pipeline.data.clips import Clip
from stages.fit_feature_basis.config import Config
from stages.fit_feature_basis.sampling import sample_descriptors

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
            qa.Check("recordings", float(len(clips))),
        ],
    )
