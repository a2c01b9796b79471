"""Describe every frame of one video by 16 unit-length features at every eighth pixel, in the shared basis."""

from dataclasses import dataclass

import numpy as np

from pipeline import cli, progress
from pipeline.files import arrays
from pipeline.files.clips import Clip
from pipeline.models.describers import Describer
from pipeline.models.features import CHANNELS, FeatureBasis
from stages.extract_features import pictures

STRIDE_PX = 8
"""Distance between features, colour pixels; what reads them counts on it."""


@dataclass(frozen=True)
class Config:
    """Nothing to set: the descriptor is chosen where its basis is fitted."""


def run(task: cli.Task) -> None:
    """Extract one video's features."""
    clip, basis = Clip.open(task.input("frames")), FeatureBasis.load(task.input("feature_basis"))
    describe = Describer.load(task.input("feature_basis")).open(lambda: task.device)
    numbers = progress.track(range(len(clip)), "features: frames")
    shape = (len(clip), *(side // STRIDE_PX for side in clip.color_size), CHANNELS)
    with task.create() as folder:
        with arrays.Rows(folder / "features.npz", features=(shape, np.float16)) as table:
            for i in numbers:
                table.append(features=basis.project(describe(clip.color(i), STRIDE_PX)).astype(np.float16))
        pictures.report_quality(folder, clip, arrays.open_lazily(folder / "features.npz", "features"))


if __name__ == "__main__":
    cli.enter(__doc__, run, config=Config, reads=("frames", "feature_basis"))
