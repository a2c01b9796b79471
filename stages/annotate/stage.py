"""The stage: frames of some recordings and the scene template -> a session of clicking, kept in one file."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from pipeline.data import clicks
from pipeline.data.clicks import ClickedClip
from pipeline.data.templates import SceneCameras
from stages.annotate.config import Config
from stages.annotate.frame_choice import sharpest_per_stretch
from stages.annotate.serving import ClickSession


@dataclass(frozen=True)
class Inputs:
    """What the page shows."""

    frames: Mapping[str, Path]
    """`frames/<id>` of each recording, by the recording's file name."""
    scene_template: Path
    walkthrough: str
    """File name of the walk-through among them."""


def run(inputs: Inputs, config: Config, clicks_file: Path) -> ClickSession:
    """Choose the frames to click in; the session, which `serving.server` serves, keeps ``clicks_file``.

    Raises InputError EVA-001 where that file is there and holds no clicks.
    """
    if clicks_file.exists():
        clicks.read(clicks_file)
    recordings = {name: ClickedClip.open(folder) for name, folder in inputs.frames.items()}
    cameras = SceneCameras.open(inputs.scene_template)
    quality = {name: each.clip.quality for name, each in recordings.items()}
    shown = {name: sharpest_per_stretch(each, config.frames) for name, each in quality.items()}
    walk = quality[inputs.walkthrough]
    shown[inputs.walkthrough] = sharpest_per_stretch(walk, config.references, cameras.registered)
    return ClickSession(recordings, shown, inputs.walkthrough, cameras.world_from_registered, clicks_file)
