"""The stage: one recording -> upright frames with depth, intrinsics, odometry, and the quality page."""

import tempfile
from dataclasses import dataclass
from pathlib import Path

from pipeline.calibration import given
from pipeline.calibration import recordings as calibration
from pipeline.core import progress
from pipeline.core.videos import Video
from pipeline.recordings import extraction
from pipeline.recordings.formats import open_recording, scale_sources
from stages.extract_frames import photogrammetry, pictures, writing
from stages.extract_frames.config import Config


@dataclass(frozen=True)
class Inputs:
    """What the stage reads."""

    recording: Path
    """File or folder as the recording app exported it."""
    captures: Path | None = None
    """Folder of all recordings, which may supply metric scale to a walk-through without depth."""
    depth: Path | None = None
    """`<recording>.depth.toml`: its depth camera and delay."""


def run(
    inputs: Inputs, config: Config, out: Path, *, videos: tuple[Video, ...] = (), video: Video | None = None
) -> None:
    """Extract one recording into `out`: frames, or pictures alone of a session or turnaround without depth.

    Raises InputError CAP-001..022, MAP-004 for what cannot be used.
    """
    recording = open_recording(inputs.recording)
    for remark in recording.remarks:
        progress.log(f"{recording.where}: {remark}")
    if recording.depth_size is None and video is not None and video.role in ("session", "turnaround"):
        pictures.write(out, recording, config)
        return
    if recording.depth_size is None and (video is None or video.role == "walkthrough"):
        sources, agreement = {}, None
        if video is not None and inputs.captures is not None:  # their depth may supply metric scale
            found = scale_sources(inputs.captures, video, videos)
            paths = {other.id: inputs.captures / other.file for other in found}
            sources = {id: (open_recording(path), given.sidecar_of(path)) for id, path in paths.items()}
        with tempfile.TemporaryDirectory() as workspace:
            plan, frames, summary = photogrammetry.map_pictures(recording, sources, config, Path(workspace))
    else:
        reach = {"max_depth_m": config.max_depth_m}
        options = {"rate_hz": config.rate_hz, "max_side_px": config.max_side_px, **reach}
        found, plan = calibration.understand(recording, given.read(inputs.depth), **options)
        if found.estimate is not None:
            progress.log(f"{recording.where}: {calibration.describe(found.estimate)}")
        for remark in found.recording.remarks[len(recording.remarks) :]:
            progress.log(f"{recording.where}: {remark}")
        recording = found.recording
        frames = extraction.frames(recording, plan, **reach)
        summary = extraction.summary(recording, plan)
        agreement = extraction.picture_agreement_of(recording, plan, **reach)
    progress.log(summary)
    if agreement is not None:
        progress.log(f"{agreement.reason}; correlation {agreement.correlation:.2f}")
    total = len(plan.chosen)
    tracked = progress.track(frames, "frames", total=total)
    written = writing.write_frames(out, tracked, config, total=total, where=recording.where)
    writing.write_table(out, recording, plan, written)
    writing.report_quality(out, recording, plan, written, agreement, rate_hz=config.rate_hz)
