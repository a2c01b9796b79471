"""The stage: frames of some recordings and the scene template -> a session of clicking, kept in one file."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float

from pipeline.data import clicks
from pipeline.data.clicks import ClickedClip
from pipeline.data.templates import SceneCameras
from stages.annotate.serving import ClickSession

FRAMES, REFERENCES = 4, 30
"""Frames to click in, of a session or held-out phone and of the walk-through."""


def run(
    frames: Mapping[str, Path], scene_template: Path, walkthrough: str, clicks_file: Path
) -> ClickSession:
    """Choose the frames to click in; the session, which `serving` shows, keeps ``clicks_file``.

    ``frames`` are the folders `frames/<id>` by file name of the recording; ``walkthrough`` is one of these.
    Raises InputError EVA-001 where that file is there and holds no clicks.
    """
    if clicks_file.exists():
        clicks.read(clicks_file)
    recordings = {name: ClickedClip.open(folder) for name, folder in frames.items()}
    cameras = SceneCameras.open(scene_template)
    quality = {name: each.clip.quality for name, each in recordings.items()}
    shown = {name: sharpest_per_stretch(each, FRAMES) for name, each in quality.items()}
    shown[walkthrough] = sharpest_per_stretch(quality[walkthrough], REFERENCES, cameras.registered)
    return ClickSession(recordings, shown, walkthrough, cameras.world_from_registered, clicks_file)


def sharpest_per_stretch(
    quality: Float[np.ndarray, "frame"], count: int, usable: Bool[np.ndarray, "frame"] | None = None
) -> list[int]:
    """Return up to ``count`` frames in order: the best usable one of each of as many equal intervals."""
    usable = np.ones(len(quality), bool) if usable is None else usable
    found = []
    for stretch in np.array_split(np.arange(len(quality)), min(count, len(quality))):
        stretch = stretch[usable[stretch]]
        if len(stretch):
            found.append(int(stretch[np.argmax(quality[stretch])]))
    return found
