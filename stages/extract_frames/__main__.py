"""Turn one phone recording into upright frames at 10 Hz with metric depth, intrinsics and odometry.

Reads Record3D (`.r3d`, EXR + JPG), Stray Scanner, Polycam raw data, NeRFCapture streams, TUM and 7-Scenes folders, and
video with depth pictures. Checks on the depth what the device poses mean. A walk-through that is a video alone is mapped
from its pictures; sessions with depth tell it metres, otherwise its scale is relative.
"""

import tempfile
from dataclasses import dataclass, field
from pathlib import Path

from pipeline import captures, cli, progress
from pipeline.recordings import extraction
from pipeline.recordings.formats import open_recording
from pipeline.recordings.recording import Recording
from pipeline.videos import Video
from stages.extract_frames import photogrammetry, writing


@dataclass(frozen=True)
class Config:
    """Settings of frame extraction."""

    rate_hz: float = 10.0
    """Frames per second to keep; gaps in the recording stay gaps."""
    max_side_px: int = 640
    """Larger pictures are divided by a whole number until their longer side fits, pixels."""
    max_depth_m: float = 6.0
    """Depth beyond this is unknown, metres; phone LiDAR reaches about 5."""
    min_depth_valid: float = 0.2
    """Frames with a smaller share (0..1) of known depth are left out."""
    check_pairs: int = 6
    """Pairs of frames on which device poses are checked against depth."""
    jpeg_quality: int = 95
    """JPEG quality 1..100 of pictures that were turned or reduced; the others keep the phone's bytes."""
    without_depth: photogrammetry.PhotogrammetryOptions = field(default_factory=photogrammetry.PhotogrammetryOptions)
    """How a walk-through is mapped that has no depth."""


def run(task: cli.Task) -> None:
    """Extract one recording."""
    settings: Config = task.config
    recording = open_recording(task.input("recording"))
    sizes = {"rate_hz": settings.rate_hz, "max_depth_m": settings.max_depth_m, "max_side_px": settings.max_side_px}
    mine = next((video for video in task.videos if video.id == task.video), None)
    if recording.depth_size is None and (mine is None or mine.role == "walkthrough"):
        measured = _telling_meters(task, mine)
        with tempfile.TemporaryDirectory() as workspace:
            mapped = photogrammetry.map_pictures(
                recording, measured, settings.without_depth, **sizes, jpeg_quality=settings.jpeg_quality, workspace=Path(workspace)
            )
        plan, frames, told = mapped.plan, mapped.frames, mapped.told
    else:
        plan = extraction.understand(recording, **sizes, pairs=settings.check_pairs)
        frames = extraction.frames(recording, plan, max_depth_m=settings.max_depth_m, jpeg_quality=settings.jpeg_quality)
        told = extraction.sentence(recording, plan)
    progress.log(told)
    frames = progress.track(frames, "frames", total=len(plan.chosen))
    with task.create() as folder:
        written = writing.write_frames(
            folder, frames, total=len(plan.chosen), min_depth_valid=settings.min_depth_valid, where=recording.where
        )
        writing.write_table(folder, recording, plan, written)
        writing.write_mesh(folder, recording, plan)
        writing.report_quality(folder, plan, written, rate_hz=settings.rate_hz)


def _telling_meters(task: cli.Task, mine: Video | None) -> dict[str, Recording]:
    """Open the recordings whose depth may tell metres to one without."""
    if mine is None or not task.has("captures"):
        return {}
    folder = task.input("captures")
    return {video.id: open_recording(folder / video.file) for video in captures.telling_meters(folder, mine, task.videos)}


if __name__ == "__main__":
    cli.enter(__doc__, run, config=Config, reads=("recording",), optional=("captures",))
