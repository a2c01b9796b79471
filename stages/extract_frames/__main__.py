"""Turn one phone recording into upright frames at 10 Hz with metric depth, intrinsics and odometry.

Reads Record3D (`.r3d`, EXR + JPG), Stray Scanner, Polycam raw data, NeRFCapture streams, TUM and 7-Scenes folders, and
video with depth pictures. Checks on the depth what the device poses mean.
"""

from dataclasses import dataclass

from pipeline import cli, progress
from pipeline.recordings import extraction
from pipeline.recordings.formats import open_recording
from stages.extract_frames import writing


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


def run(task: cli.Task) -> None:
    """Extract one recording."""
    settings: Config = task.config
    recording = open_recording(task.input("recording"))
    plan = extraction.understand(
        recording,
        rate_hz=settings.rate_hz,
        max_depth_m=settings.max_depth_m,
        pairs=settings.check_pairs,
        max_side_px=settings.max_side_px,
    )
    progress.log(extraction.sentence(recording, plan))
    frames = extraction.frames(recording, plan, max_depth_m=settings.max_depth_m, jpeg_quality=settings.jpeg_quality)
    frames = progress.track(frames, "frames", total=len(plan.chosen))
    with task.create() as folder:
        written = writing.write_frames(
            folder, frames, total=len(plan.chosen), min_depth_valid=settings.min_depth_valid, where=recording.where
        )
        writing.write_table(folder, recording, plan, written)
        writing.report_quality(folder, plan, written, rate_hz=settings.rate_hz)


if __name__ == "__main__":
    cli.enter(__doc__, run, config=Config, reads=("recording",))
