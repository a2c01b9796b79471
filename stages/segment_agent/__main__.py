"""Segment the animal in one recording: masks 255 agent, 0 not, 128 unknown; by default without any trained weights.

Sessions: the animal is what lies in space that other frames saw through, tracked over the whole recording, so that it
is kept while it rests; a small network then learns its looks and finds it where it never moved. One that rests all the
time is what stands out from the ground where a hint points. Turnaround: it is what stands on the ground where all cameras
look. No map is used.
A recording without depth needs a hint and is followed from there by colour and flow.
`--prompt FILE` points at it, in TOML: `frame = 12` or `time_s = 1.2`, and `box = [x0, y0, x1, y1]` or `click = [x, y]`,
in pixels of the stored picture or in shares (0..1) of it. `make` gives `captures/<agent>/<recording>.prompt.toml`.

    python -m stages.segment_agent --frames build/cat/frames/v002 --flow build/cat/flow/v002 --out build/cat/masks/v002
"""

from dataclasses import dataclass, field
from typing import Literal, assert_never

import numpy as np

from pipeline import cli, qa
from pipeline.files.clips import Clip
from pipeline.progress import log, track
from stages.segment_agent import pictures, prompt, writing
from stages.segment_agent.backends import foundation
from stages.segment_agent.backends.foundation import Foundation
from stages.segment_agent.masks import Options, segment


@dataclass(frozen=True)
class Config(Options):
    """Options of this stage."""

    backend: Literal["weightless", "foundation"] = "weightless"
    """By motion and space, or by Grounding DINO and SAM 2 (`make extras`, and their checkpoints)."""
    foundation: Foundation = field(default_factory=Foundation)
    """Options of the latter."""
    role: Literal["turnaround", "session"] = "session"
    """Role of the recording where the list of recordings does not tell it."""
    seed: int = 0
    """Seed of the random numbers."""


def run(task: cli.Task) -> None:
    """Segment one recording and write its masks."""
    clip, flow = Clip.open(task.input("frames")), task.input("flow")
    role = next((video.role for video in task.videos if video.id == task.video), task.config.role)
    hint = prompt.parse(task.input("prompt"), clip) if task.has("prompt") else None
    match task.config.backend:
        case "weightless":
            if clip.odometry_from_camera is None:
                log("no usable odometry: the motion comes from depth and flow, which drifts more")
            masks, path = segment(clip, flow, role, hint, task.config, np.random.default_rng(task.config.seed))
            if path is not None:
                log(f"poses: {path.alignments} alignments of depth pictures agree within {1000 * path.residual_m:.0f} mm")
            residual_m = np.nan if path is None else path.residual_m
        case "foundation":
            masks, residual_m = foundation.segment(clip, hint, task.config.foundation, task.device), np.nan
        case _:
            assert_never(task.config.backend)
    with task.create() as folder:
        summary = writing.write(folder, track(masks, "masks", len(clip)), len(clip))
        checks, shown = pictures.report(clip, summary.shown, np.array(summary.area), np.array(summary.visible), residual_m)
        qa.write(
            folder,
            good="the green outline hugs the animal in every frame, resting frames too",
            bad="the outline sits on furniture, flickers, or is missing while the animal is in view",
            checks=checks,
            pictures=shown,
        )
    if not any(summary.visible):
        log("the animal was never seen: does it move in this recording? A hint (<recording>.prompt.toml) helps")


if __name__ == "__main__":
    cli.enter(__doc__, run, config=Config, reads=("frames", "flow"), optional=("prompt",))
