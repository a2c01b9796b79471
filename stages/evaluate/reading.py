"""Open what is measured, and bring truth into our frames."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from pipeline.files import arrays
from pipeline.files.clips import Clip
from pipeline.models import motion
from pipeline.models.motion import Motion
from pipeline.space import rigid
from pipeline.videos import Video
from stages.evaluate.alignment import constant_between
from stages.evaluate.truth import Truth


@dataclass(frozen=True)
class Reconstructed:
    """Where a reconstruction stands and what it is compared with; frames by the recording's id."""

    frames: Mapping[str, Path]
    scene_template: Path
    agent_template: Path
    reconstruction: Path
    truth: Path | None
    """None for a user's own recordings"""


@dataclass(frozen=True)
class Folders(Reconstructed):
    """Where all finished artifacts stand; per-recording ones by id."""

    masks: Mapping[str, Path]
    flow: Mapping[str, Path]
    scene_localizer: Path
    registration: Path
    splats: Path
    behavior_data: Path
    behavior: Path
    clicks: Path | None = None
    """file of clicked correspondences, where there is one"""


@dataclass(frozen=True)
class Recorded:
    """One recording with its truth."""

    video: Video
    name: str
    """of its truth files"""
    clip: Clip
    truth: Truth
    source_index: Int[np.ndarray, "frame"]


@dataclass(frozen=True)
class Frames:
    """How truth's frames of reference lie in ours."""

    world_from_true_world: Float[np.ndarray, "4 4"]
    """fitted on the walk-through's cameras only, no scale"""
    agent_from_true_agent: Float[np.ndarray, "4 4"]
    """fitted on the turnaround only"""

    def cameras(self, truth: Truth) -> Float[np.ndarray, "frame 4 4"]:
        """Return the true cameras in our world."""
        return self.world_from_true_world @ truth.world_from_camera

    def roots(self, truth: Truth) -> Float[np.ndarray, "frame 4 4"]:
        """Return the pose that our agent frame truly has in our world."""
        return self.world_from_true_world @ truth.world_from_agent @ rigid.inverse(self.agent_from_true_agent)


def recorded(folders: Reconstructed, videos: tuple[Video, ...]) -> list[Recorded]:
    """Open every recording whose truth there is, in id order."""
    found = []
    for video in videos:
        name = Path(video.file).stem
        if not (folders.truth / f"{name}.npz").exists():
            continue
        source_index = arrays.load(folders.frames[video.id] / "frames.npz", ("source_index",))["source_index"]
        truth = Truth.open(folders.truth, name, source_index)
        found.append(Recorded(video, name, Clip.open(folders.frames[video.id]), truth, source_index))
    return found


def frames_of_truth(folders: Reconstructed, walkthrough: Recorded, turnaround: Recorded) -> Frames:
    """Fit how truth lies in our frames."""
    true_agent_from_camera = rigid.inverse(turnaround.truth.world_from_agent) @ turnaround.truth.world_from_camera
    ours = _template_cameras(folders.scene_template, "world_from_camera")
    around = _template_cameras(folders.agent_template, "agent_from_camera")
    return Frames(constant_between(ours, walkthrough.truth.world_from_camera), constant_between(around, true_agent_from_camera))


def filmed_together(folders: Reconstructed, phone: Video) -> Int[np.ndarray, "frame"]:
    """Return the frames of a held-out phone that lie within the session that it is synchronized with."""
    when, session_s = (
        arrays.load(folders.frames[id] / "frames.npz", ("timestamp_s",))["timestamp_s"] for id in (phone.id, phone.synchronized_with)
    )
    when = when + phone.offset_s
    return np.flatnonzero((when >= session_s[0]) & (when <= session_s[-1]))


def spread(frames: Int[np.ndarray, "frame"], count: int) -> Int[np.ndarray, "frame"]:
    """Return up to ``count`` of the frames, evenly spread."""
    return frames[np.unique(np.linspace(0, len(frames) - 1, min(count, len(frames))).astype(int))]


def _template_cameras(folder: Path, name: str) -> Float[np.ndarray, "frame 4 4"]:
    table = arrays.load(folder / "cameras.npz")
    return np.where(table["registered"][:, None, None], table[name], np.nan)


def read_motion(folder: Path, id: str) -> Motion | None:
    """Read one video's motion; None where it was refused."""
    path = folder / id / "motion.npz"
    return motion.load(path) if path.exists() else None


def read_registration(folder: Path, id: str) -> dict[str, np.ndarray] | None:
    """Read one video's registered poses; None where it was refused."""
    path = folder / id / "poses.npz"
    return arrays.load(path) if path.exists() else None
