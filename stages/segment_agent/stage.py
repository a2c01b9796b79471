"""The stage: frames and flow of one recording -> a mask per frame and the quality page."""

import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import assert_never

import numpy as np

from pipeline.core import devices
from pipeline.core.errors import InputError
from pipeline.core.progress import log
from pipeline.core.videos import Video, role_of_animal
from pipeline.data import qa
from pipeline.data.clips import Clip
from pipeline.segmentation.recognizer import load
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
    """The artifact `identities`; then all animals of the home are segmented."""
    home_masks: Path | None = None
    """`home_masks/<id>`, the masks of all animals of the home."""
    recognizer: Path | None = None
    """The artifact `recognizer`, for a session whose depth comes from the map."""


def run(
    inputs: Inputs,
    config: Config,
    out: Path,
    *,
    device: devices.Device = "cpu",
    video: Video | None = None,
    videos: Sequence[Video] = (),
) -> None:
    """Segment one recording and write its masks into `out`.

    With `identities`, the masks of each animal are written into a folder with its name. With `home_masks`,
    those of the animal whose turnaround is among `videos` are copied. Raises InputError MSK-006 for a prompt
    or a backend that cannot distinguish animals.
    """
    if inputs.home_masks is not None:
        name = next(video.animal for video in videos if video.animal)
        shutil.copytree(inputs.home_masks / name, out, dirs_exist_ok=True)
        return
    clip, role = Clip.open(inputs.frames), role_of_animal(video, config.role)
    if inputs.identities is not None:
        _segment_home(clip, inputs, inputs.identities, config, out)
        return
    prompt = None if inputs.prompt is None else prompts.parse(inputs.prompt, clip)
    match config.backend:
        case "weightless":
            if clip.odometry_from_camera is None:
                log("no usable odometry: camera motion comes from depth and flow, which drifts more")
            rng = np.random.default_rng(config.seed)
            known = None if inputs.recognizer is None else load(inputs.recognizer)
            found = segment(clip, inputs.flow, role, prompt, config, rng, known)
            if found.path is not None:
                millimeters = MM * found.path.residual_m
                log(f"poses: {found.path.alignments} depth alignments agree within {millimeters:.0f} mm")
        case "foundation":
            from stages.segment_agent.backends import foundation

            found = Segmentation(foundation.segment(clip, prompt, config.foundation, device))
        case _:
            assert_never(config.backend)
    writing.write(out, clip, found, config.animal)


def _segment_home(clip: Clip, inputs: Inputs, identities: Path, config: Config, out: Path) -> None:
    if inputs.prompt is not None or config.backend != "weightless":
        what = "a prompt" if inputs.prompt is not None else f"the backend {config.backend!r}"
        raise InputError(
            "MSK-006",
            f"{what} does not say which of several animals is meant",
            str(inputs.prompt or inputs.frames),
            "leave it out: sessions of several animals are segmented by motion and by their turnarounds",
        )
    network, portraits = Identities.load(identities), load_portraits(identities)
    checks: list[qa.Check] = []
    for name, found in several.segment(clip, inputs.flow, network, portraits, config).items():
        (out / name).mkdir()
        own = writing.write(out / name, clip, found, config.animal)
        checks += [replace(check, name=f"{name}: {check.name}") for check in own]
    good, bad = "the checks of every animal pass", "an animal's masks are wrong: see its own quality page"
    qa.write(out, good=good, bad=bad, checks=checks)
