"""Estimate the optical flow of one video between frames 1, 2, 4 and 8 apart, forward and backward, with confidence."""

from dataclasses import dataclass
from functools import lru_cache

from pipeline import cli, progress
from pipeline.files import arrays
from pipeline.files.clips import Clip
from stages.estimate_flow import pictures
from stages.estimate_flow.estimation import Estimator, Search, flows

GAPS = (1, 2, 4, 8)


@dataclass(frozen=True)
class Config:
    """Settings of flow estimation."""

    working_side_px: int = 320
    """Pictures are searched at this longer side, pixels."""
    patch_stride_px: int = 3
    """Distance between patches, reduced pixels."""
    iterations: int = 12
    """Descent steps per patch."""
    tolerance_px: float = 1.5
    """Forward-backward error at which confidence is 1/e, reduced pixels."""


def run(task: cli.Task) -> None:
    """Estimate all gaps of one video."""
    settings: Config = task.config
    clip = Clip.open(task.input("frames"))
    search = Search(settings.working_side_px, settings.patch_stride_px, settings.iterations)
    estimator = Estimator(clip.color_size, search, tolerance_px=settings.tolerance_px)
    gray = lru_cache(maxsize=4096)(lambda frame: estimator.reduce(clip.color(frame)))
    reviews = []
    with task.create() as folder:
        for gap, forward, backward in progress.track(flows(gray, len(clip), GAPS, estimator), "flow: gaps", len(GAPS)):
            for way, part in (("fw", forward), ("bw", backward)):
                arrays.save(folder / f"flow_{gap}_{way}.npz", flow=part.flow, confidence=part.confidence)
            reviews.append(pictures.review(gap, forward, clip.color))
        pictures.report_quality(folder, reviews)


if __name__ == "__main__":
    cli.enter(__doc__, run, config=Config, reads=("frames",))
