"""The stage: frames and flow of one recording -> a mask per frame and the quality page."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, assert_never

import numpy as np

from pipeline.core import devices
from pipeline.core.progress import log, track
from pipeline.core.videos import Video
from pipeline.data.clips import Clip
from stages.segment_agent import pictures, prompt, writing
from stages.segment_agent.config import Config
from stages.segment_agent.masks import segment

MM = 1000


@dataclass(frozen=True)
class Inputs:
    """What the stage reads."""

    frames: Path
    """`frames/<id>` of the recording."""
    flow: Path
    """`flow/<id>` of the recording."""
    prompt: Path | None = None
    """A user's hint where the animal is."""


def run(
    inputs: Inputs, config: Config, out: Path, *, device: devices.Device = "cpu", video: Video | None = None
) -> writing.Summary:
    """Segment one recording and write its masks into `out`."""
    clip = Clip.open(inputs.frames)
    hint = None if inputs.prompt is None else prompt.parse(inputs.prompt, clip)
    residual_m = np.nan
    match config.backend:
        case "weightless":
            if clip.odometry_from_camera is None:
                log("no usable odometry: the motion comes from depth and flow, which drifts more")
            rng = np.random.default_rng(config.seed)
            masks, path = segment(clip, inputs.flow, _role(config, video), hint, config, rng)
            if path is not None:
                residual_m = path.residual_m
                log(f"poses: {path.alignments} depth alignments agree within {MM * residual_m:.0f} mm")
        case "foundation":
            from stages.segment_agent.backends import foundation

            masks = foundation.segment(clip, hint, config.foundation, device)
        case _:
            assert_never(config.backend)
    summary = writing.write(out, track(masks, "masks", len(clip)), len(clip))
    pictures.report_quality(out, clip, summary, residual_m)
    if not any(summary.visible):
        log("the animal was never seen: does it move here? A hint (<recording>.prompt.toml) helps")
    return summary


def _role(config: Config, video: Video | None) -> Literal["turnaround", "session"]:
    if video is None:
        return config.role
    return "turnaround" if video.role == "turnaround" else "session"
