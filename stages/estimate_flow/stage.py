"""The stage: frames of one recording -> flow tables and the quality page."""

from contextlib import ExitStack
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import assert_never

from pipeline.core import devices, progress
from pipeline.data import npz
from pipeline.data.clips import Clip
from pipeline.data.flow import GAPS, writer
from stages.estimate_flow import pictures
from stages.estimate_flow.config import Config
from stages.estimate_flow.estimation import Estimator, flows


@dataclass(frozen=True)
class Inputs:
    """What the stage reads."""

    frames: Path
    """`frames/<id>` of the recording."""


def run(inputs: Inputs, config: Config, out: Path, *, device: devices.Device = "cpu") -> None:
    """Estimate the flow of all gaps, both ways, of one recording into `out`."""
    clip = Clip.open(inputs.frames)
    estimator = _estimator(config, clip.color_size, device)
    gray = lru_cache(maxsize=2 * GAPS[-1])(lambda frame: estimator.reduce(clip.color(frame)))
    pairs = sum(max(len(clip) - gap, 0) for gap in GAPS)
    with ExitStack() as stack:
        tables = {
            (gap, direction): stack.enter_context(_table(out, gap, direction, clip, estimator))
            for gap in GAPS
            for direction in ("fw", "bw")
        }
        estimated = flows(gray, len(clip), GAPS, estimator)
        for gap, forward, backward in progress.track(estimated, "flow: pairs", pairs):
            tables[gap, "fw"].append(flow=forward.flow, confidence=forward.confidence)
            tables[gap, "bw"].append(flow=backward.flow, confidence=backward.confidence)
    pictures.report_quality(out, [pictures.review(out, gap, clip.color) for gap in GAPS])


def _table(folder: Path, gap: int, direction: str, clip: Clip, estimator: Estimator) -> npz.Rows:
    frames, size = max(len(clip) - gap, 0), estimator.grid_px.shape[:2]
    return writer(folder, gap, frames, size, backward=direction == "bw")


def _estimator(config: Config, color_size: tuple[int, int], device: devices.Device) -> Estimator:
    match config.backend:
        case "search":
            return Estimator(color_size, config.working_side_px)
        case "raft":
            from pipeline.backends import raft
            from stages.estimate_flow.backends.raft import RaftEstimator

            network = raft.load(Path(config.weights), device)
            return RaftEstimator(network, color_size, config.working_side_px)
        case _:
            assert_never(config.backend)
