"""Collect every session's poses and status into one registration, with a summary and a picture of paths."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from pipeline.core import progress
from pipeline.core.errors import InputError
from pipeline.core.videos import Video
from pipeline.data import qa
from pipeline.data.poses import RegisteredPoses
from pipeline.geometry import views
from stages.gather_registration.config import Config

EDGE_PX, MARGIN_PX = 560, 20
"""Size and margin of the picture of all paths."""
FONT_SCALE = 0.45
COLORS = ((220, 60, 50), (50, 110, 210), (60, 160, 80), (200, 140, 30), (140, 80, 180), (40, 160, 170))


@dataclass(frozen=True)
class Inputs:
    """Folders of finished artifacts, by recording."""

    video_poses: Mapping[str, Path]


@dataclass(frozen=True)
class SessionOutcome:
    """One recording's status, and its poses if it was registered."""

    video: str
    status: dict
    poses: RegisteredPoses | None
    file: str = ""
    """Name of the recording in the capture folder."""

    @property
    def description(self) -> str:
        """Return why a recording was rejected, and its nearest view."""
        nearest = self.status.get("nearest_view")
        view = (
            f"; its nearest view is the walk-through at {nearest['walkthrough_s']:.1f} s" if nearest else ""
        )
        return f"{self.file or self.video}: {self.status['reason']}{view}"


def run(inputs: Inputs, config: Config, out: Path, *, videos: tuple[Video, ...] = ()) -> dict:
    """Copy poses of registered recordings, write and return the summary. Raises REG-001 for too few."""
    outcomes, names = [], {video.id: video.file for video in videos}
    for video, folder in inputs.video_poses.items():
        status = json.loads((folder / "status.json").read_text())
        poses = RegisteredPoses.open(folder) if status["registered"] else None
        outcomes.append(SessionOutcome(video, status, poses, names.get(video, "")))
    summary = summarize(outcomes)
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
        checks=checks(outcomes),
        pictures=[qa.Picture("paths", paths(outcomes), "From above: phones thin, animals thick.")],
    )  # fmt: skip
    return summary


def summarize(outcomes: list[SessionOutcome]) -> dict:
    """Return the content of ``summary.json``."""
    return {
        "registered": sum(outcome.poses is not None for outcome in outcomes),
        "total": len(outcomes),
        "videos": {outcome.video: {"file": outcome.file, **outcome.status} for outcome in outcomes},
    }


def checks(outcomes: list[SessionOutcome]) -> list[qa.Check]:
    """Return the quality checks."""
    share = sum(outcome.poses is not None for outcome in outcomes) / max(len(outcomes), 1)
    figures = [outcome.status["figures"] for outcome in outcomes if outcome.poses is not None]
    gaps = [figure["depth_gap_m"] for figure in figures if figure["depth_gap_m"] is not None]
    confidence = float(np.mean([figure["confidence"] for figure in figures])) if figures else None
    gap_cm = [100 * float(np.median(gaps))] if gaps else []
    return [
        qa.Check("recordings registered", share, "share", 0.99, 0.5, "higher"),
        *(qa.Check("depth against the template", each, "cm, median", 2.5, 6.0) for each in gap_cm),
        qa.Check("camera confidence", confidence, "mean probability", 0.6, 0.2, "higher"),
    ]


def paths(outcomes: list[SessionOutcome]) -> UInt8[np.ndarray, "height width 3"]:
    """Draw all registered paths from above: phones thin, animals thick, one color a recording."""
    image = np.full((EDGE_PX, EDGE_PX, 3), views.BACKGROUND, np.uint8)
    registered = {each.video: each.poses for each in outcomes if each.poses is not None}
    if not registered:
        return image
    pairs = {video: (poses.world_from_camera, poses.world_from_agent) for video, poses in registered.items()}
    ground = np.concatenate([each[:, [0, 2], 3] for pair in pairs.values() for each in pair])
    low, high = np.nanmin(ground, axis=0), np.nanmax(ground, axis=0)
    meter_px = (EDGE_PX - 2 * MARGIN_PX) / max(float((high - low).max()), 0.1)
    overview = views.Overview(image, low - MARGIN_PX / meter_px, meter_px)
    for index, (video, (cameras, agents)) in enumerate(pairs.items()):
        color, corner = COLORS[index % len(COLORS)], (10, 16 * (index + 1))
        overview.draw(cameras[:, :3, 3], color, 1)
        overview.draw(agents[:, :3, 3], color, 3)
        cv2.putText(image, video, corner, cv2.FONT_HERSHEY_SIMPLEX, FONT_SCALE, color, 1, cv2.LINE_AA)
    return image
