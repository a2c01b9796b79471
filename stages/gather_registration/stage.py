"""Collect every session's poses and status into one registration."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from pipeline.core import progress
from pipeline.core.errors import InputError
from pipeline.core.videos import Video
from pipeline.data import qa
from pipeline.data.poses import RegisteredPoses
from stages.gather_registration import gather
from stages.gather_registration.config import Config


@dataclass(frozen=True)
class Inputs:
    """Folders of finished artifacts, by recording."""

    video_poses: Mapping[str, Path]


def run(inputs: Inputs, config: Config, out: Path, *, videos: tuple[Video, ...] = ()) -> dict:
    """Copy poses of registered recordings, write and return the summary. Raises REG-001 for too few."""
    outcomes, names = [], {video.id: video.file for video in videos}
    for video, folder in inputs.video_poses.items():
        status = json.loads((folder / "status.json").read_text())
        poses = RegisteredPoses.open(folder) if status["registered"] else None
        outcomes.append(gather.SessionOutcome(video, status, poses, names.get(video, "")))
    summary = gather.summarize(outcomes)
    rejected = [outcome.description for outcome in outcomes if outcome.poses is None]
    if summary["registered"] < config.min_registered:
        raise InputError(
            "REG-001",
            f"{summary['registered']} of {summary['total']} sessions fit the walk-through "
            f"({'; '.join(rejected)})",
            "video_poses",
            "record a walk-through that shows the whole room, or sessions in that room",
        )
    for description in rejected:
        progress.log(f"rejected {description}")
    for outcome in outcomes:
        if outcome.poses is not None:
            (out / outcome.video).mkdir()
            outcome.poses.write(out / outcome.video)
    (out / "summary.json").write_text(json.dumps(summary, indent=1) + "\n")
    qa.write(
        out, good="all recordings are registered and their paths share one room",
        bad="recordings are rejected, or a path is displaced from the others",
        checks=gather.checks(outcomes),
        pictures=[qa.Picture("paths", gather.paths(outcomes), "From above: phones thin, animals thick.")],
    )  # fmt: skip
    return summary
