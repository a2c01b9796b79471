"""Open what is measured, and bring truth into our frames."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from pipeline.core.videos import Role, Video
from pipeline.data import motion
from pipeline.data.clips import FRAMES, Clip, read_source_index
from pipeline.data.motion import Motion
from pipeline.data.templates import AgentCameras, SceneCameras
from pipeline.geometry import rigid
from pipeline.metrics.pose_errors import constant_between
from stages.evaluate.truth import RecordingTruth


@dataclass(frozen=True, kw_only=True)
class Reconstructed:
    """Where a reconstruction stands and what it is compared with; frames by the recording's id."""

    frames: Mapping[str, Path]
    scene_template: Path
    agent_template: Path
    reconstruction: Path
    truth: Path | None = None
    """None for a user's own recordings"""

    @property
    def truth_folder(self) -> Path:
        """The folder of the truth; only where it is known."""
        assert self.truth is not None, "the true poses of this capture are not known"
        return self.truth


@dataclass(frozen=True, kw_only=True)
class BuildFolders(Reconstructed):
    """Where the artifacts before behavior stand; per-recording ones by id."""

    masks: Mapping[str, Path]
    flow: Mapping[str, Path]
    scene_localizer: Path
    registration: Path
    splats: Path
    clicks: Path | None = None
    """file of clicked correspondences, where there is one"""


@dataclass(frozen=True)
class RecordingWithTruth:
    """One recording with its truth."""

    video: Video
    name: str
    """of its truth files"""
    clip: Clip
    truth: RecordingTruth
    source_index: Int[np.ndarray, "frame"]


@dataclass(frozen=True)
class TruthAlignment:
    """How truth's frames of reference lie in ours."""

    world_from_true_world: Float[np.ndarray, "4 4"]
    """fitted on the walk-through's cameras only, no scale"""
    agent_from_true_agent: Float[np.ndarray, "4 4"]
    """fitted on the turnaround only"""

    def cameras(self, truth: RecordingTruth) -> Float[np.ndarray, "frame 4 4"]:
        """Return the true cameras in our world."""
        return self.world_from_true_world @ truth.world_from_camera

    def roots(self, truth: RecordingTruth) -> Float[np.ndarray, "frame 4 4"]:
        """Return the pose that our agent frame truly has in our world."""
        return self.world_from_true_world @ truth.world_from_agent @ rigid.inverse(self.agent_from_true_agent)


def recorded(folders: Reconstructed, videos: tuple[Video, ...]) -> list[RecordingWithTruth]:
    """Open every recording whose truth there is, in id order."""
    found = []
    for video in videos:
        name = Path(video.file).stem
        if not (folders.truth_folder / f"{name}.npz").exists():
            continue
        source_index = read_source_index(folders.frames[video.id])
        truth = RecordingTruth.open(folders.truth_folder, name, source_index)
        clip = Clip.open(folders.frames[video.id])
        found.append(RecordingWithTruth(video, name, clip, truth, source_index))
    return found


def of_role(known: Sequence[RecordingWithTruth], role: Role) -> list[RecordingWithTruth]:
    """Return the recordings of a role."""
    return [each for each in known if each.video.role == role]


def frames_of_truth(folders: Reconstructed, known: Sequence[RecordingWithTruth]) -> TruthAlignment:
    """Fit how truth lies in our frames."""
    (walkthrough, *_), (turnaround, *_) = (of_role(known, role) for role in ("walkthrough", "turnaround"))
    true_agent_from_camera = (
        rigid.inverse(turnaround.truth.world_from_agent) @ turnaround.truth.world_from_camera
    )
    ours = SceneCameras.open(folders.scene_template).world_from_registered
    around = AgentCameras.open(folders.agent_template).agent_from_registered
    return TruthAlignment(
        constant_between(ours, walkthrough.truth.world_from_camera),
        constant_between(around, true_agent_from_camera),
    )


def filmed_together(folders: Reconstructed, phone: Video) -> Int[np.ndarray, "frame"]:
    """Return the frames of a held-out phone that lie within the session that it is synchronized with."""
    assert phone.synchronized_with is not None, f"{phone.id} shares its clock with no session"
    when, session_s = (
        FRAMES.load(folders.frames[id] / "frames.npz", "timestamp_s")["timestamp_s"]
        for id in (phone.id, phone.synchronized_with)
    )
    when = when + phone.offset_s
    return np.flatnonzero((when >= session_s[0]) & (when <= session_s[-1]))


def read_motion(folder: Path, id: str) -> Motion | None:
    """Read one video's motion; None where it was refused."""
    path = folder / id / "motion.npz"
    return motion.load(path) if path.exists() else None
