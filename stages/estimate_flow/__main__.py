"""Estimate the optical flow of one video between frames 1, 2, 4 and 8 apart, forward and backward, with confidence."""

from contextlib import ExitStack
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Literal, assert_never

import numpy as np

from pipeline import cli, progress
from pipeline.files import arrays
from pipeline.files.clips import Clip
from stages.estimate_flow import pictures
from stages.estimate_flow.estimation import Estimator, Search, flows

GAPS = (1, 2, 4, 8)


@dataclass(frozen=True)
class Config:
    """Settings of flow estimation."""

    backend: Literal["search", "raft"] = "search"
    """Dense inverse search without weights, or RAFT with its authors' weights."""
    weights: str = ""
    """RAFT's weights (`raft-things.pth`)."""
    updates: int = 20
    """RAFT's iterations."""
    working_side_px: int = 1280
    """Pictures with a longer side are searched at this one, pixels; reducing further is faster and blurs outlines."""
    patch_stride_px: int = 3
    """Distance between patches, reduced pixels."""
    iterations: int = 50
    """Descent steps per patch."""
    tolerance_px: float = 1.5
    """Forward-backward error at which confidence is 1/e, reduced pixels."""


def run(task: cli.Task) -> None:
    """Estimate all gaps of one video."""
    clip = Clip.open(task.input("frames"))
    estimator = _estimator(task, clip.color_size)
    gray = lru_cache(maxsize=2 * GAPS[-1])(lambda frame: estimator.reduce(clip.color(frame)))
    pairs = sum(max(len(clip) - gap, 0) for gap in GAPS)
    with task.create() as folder:
        with ExitStack() as stack:
            tables = {(gap, way): stack.enter_context(_table(folder, gap, way, clip, estimator)) for gap in GAPS for way in ("fw", "bw")}
            for gap, forward, backward in progress.track(flows(gray, len(clip), GAPS, estimator), "flow: pairs", pairs):
                tables[gap, "fw"].append(flow=forward.flow, confidence=forward.confidence)
                tables[gap, "bw"].append(flow=backward.flow, confidence=backward.confidence)
        pictures.report_quality(folder, [pictures.review(folder, gap, clip.color) for gap in GAPS])


def _table(folder: Path, gap: int, way: str, clip: Clip, estimator: Estimator) -> arrays.Rows:
    shape = (max(len(clip) - gap, 0), *estimator.grid_px.shape[:2])
    return arrays.Rows(folder / f"flow_{gap}_{way}.npz", flow=((*shape, 2), np.float16), confidence=(shape, np.uint8))


def _estimator(task: cli.Task, color_size: tuple[int, int]) -> Estimator:
    settings: Config = task.config
    search = Search(settings.working_side_px, settings.patch_stride_px, settings.iterations)
    match settings.backend:
        case "search":
            return Estimator(color_size, search, tolerance_px=settings.tolerance_px)
        case "raft":
            from pipeline.models import raft
            from stages.estimate_flow.backends.raft import RaftEstimator

            network = raft.load(Path(settings.weights or "raft-things.pth"), task.device)
            return RaftEstimator(network, color_size, search, tolerance_px=settings.tolerance_px, iterations=settings.updates)
        case _:
            assert_never(settings.backend)


if __name__ == "__main__":
    cli.enter(__doc__, run, config=Config, reads=("frames",))
