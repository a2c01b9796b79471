"""The stage: frames and flow of one recording -> a mask per frame and the quality page."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import assert_never

import numpy as np

from pipeline.core import devices
from pipeline.core.errors import InputError
from pipeline.core.progress import log, track
from pipeline.core.videos import Video, role_of_animal
from pipeline.data.clips import Clip
from stages.segment_agent import prompts, several, writing
from stages.segment_agent.config import Config
from stages.segment_agent.identity import Identities, load_portraits
from stages.segment_agent.masks import Segmentation, segment

MM = 1000


@dataclass(frozen=True)
class Inputs:
    """What the stage reads."""

    frames: Path
    """`frames/<id>` of the recording."""
    flow: Path
    """`flow/<id>` of the recording."""
    prompt: Path | None = None
    """A box or a click on the animal, given by a user."""
    identities: Path | None = None
    """The artifact `identities`, in a home of several animals."""


def run(
    inputs: Inputs,
    config: Config,
    out: Path,
    *,
    device: devices.Device = "cpu",
    video: Video | None = None,
    videos: Sequence[Video] = (),
) -> writing.Summary:
    """Segment one recording and write its masks into `out`.

    With several animals, the one whose turnaround is among `videos` is segmented. Raises InputError
    MSK-006 for a prompt or a backend that cannot distinguish them.
    """
    clip, role = Clip.open(inputs.frames), role_of_animal(video, config.role)
    if inputs.identities is not None and role == "session":
        found = _segment_one_of_several(clip, inputs, inputs.identities, config, videos)
    else:
        prompt = None if inputs.prompt is None else prompts.parse(inputs.prompt, clip)
        match config.backend:
            case "weightless":
                if clip.odometry_from_camera is None:
                    log("no usable odometry: camera motion comes from depth and flow, which drifts more")
                rng = np.random.default_rng(config.seed)
                found = segment(clip, inputs.flow, role, prompt, config, rng)
                if found.path is not None:
                    millimeters = MM * found.path.residual_m
                    log(f"poses: {found.path.alignments} depth alignments agree within {millimeters:.0f} mm")
            case "foundation":
                from stages.segment_agent.backends import foundation

                found = Segmentation(foundation.segment(clip, prompt, config.foundation, device))
            case _:
                assert_never(config.backend)
    writing.write_people(out, clip, found)
    summary = writing.write(out, track(found.masks, "masks", len(clip)), len(clip))
    writing.report_quality(out, clip, summary, config.animal, found)
    if found.unknown_animals is None and not any(summary.visible):
        log("the animal was never seen: does it move here? A prompt (<recording>.prompt.toml) helps")
    return summary


def _segment_one_of_several(
    clip: Clip, inputs: Inputs, identities: Path, config: Config, videos: Sequence[Video]
) -> Segmentation:
    if inputs.prompt is not None or config.backend != "weightless":
        what = "a prompt" if inputs.prompt is not None else f"the backend {config.backend!r}"
        raise InputError(
            "MSK-006",
            f"{what} does not say which of several animals is meant",
            str(inputs.prompt or inputs.frames),
            "leave it out: sessions of several animals are segmented by motion and by their turnarounds",
        )
    followed = next(video.animal for video in videos if video.animal)
    assert followed is not None, "the planner lists one animal's turnaround"
    network, portraits = Identities.load(identities), load_portraits(identities)
    return several.segment(clip, inputs.flow, followed, network, portraits, config)
