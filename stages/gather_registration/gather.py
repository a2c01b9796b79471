"""Summarise what was registered and what was rejected, and draw all paths into one picture."""

import itertools
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import UInt8

from pipeline.data.poses import RegisteredPoses
from pipeline.data.qa import Check

COLORS = ((220, 60, 50), (50, 110, 210), (60, 160, 80), (200, 140, 30), (140, 80, 180), (40, 160, 170))


@dataclass(frozen=True)
class SessionOutcome:
    """One recording's status, and its poses where it was registered."""

    video: str
    status: dict
    poses: RegisteredPoses | None
    file: str = ""
    """Name of the recording in the capture folder."""

    @property
    def description(self) -> str:
        """Return why a recording was rejected, and what it resembles most."""
        nearest = self.status.get("nearest_view")
        view = (
            f"; its nearest view is the walk-through at {nearest['walkthrough_s']:.1f} s" if nearest else ""
        )
        return f"{self.file or self.video}: {self.status['reason']}{view}"


def summarise(outcomes: list[SessionOutcome]) -> dict:
    """Return the content of ``summary.json``."""
    return {
        "registered": sum(outcome.poses is not None for outcome in outcomes),
        "total": len(outcomes),
        "videos": {outcome.video: {"file": outcome.file, **outcome.status} for outcome in outcomes},
    }


def checks(outcomes: list[SessionOutcome]) -> list[Check]:
    """Judge the whole."""
    share = sum(outcome.poses is not None for outcome in outcomes) / max(len(outcomes), 1)
    figures = [outcome.status["figures"] for outcome in outcomes if outcome.poses is not None]
    gaps = [figure["depth_gap_m"] for figure in figures if figure["depth_gap_m"] is not None]
    gap = float(np.median(gaps) * 100) if gaps else None
    confidence = float(np.mean([figure["confidence"] for figure in figures])) if figures else None
    return [
        Check("recordings registered", share, "share", 0.99, 0.5, "higher"),
        Check("depth against the template", gap, "cm, median", 2.5, 6.0),
        Check("camera confidence", confidence, "mean probability", 0.6, 0.2, "higher"),
    ]


def paths(outcomes: list[SessionOutcome], edge_px: int = 560) -> UInt8[np.ndarray, "height width 3"]:
    """Draw all registered paths from above in one picture: phones thin, animals thick, one colour a
    recording."""
    known = [outcome for outcome in outcomes if outcome.poses is not None]
    image = np.full((edge_px, edge_px, 3), 252, np.uint8)
    if not known:
        return image
    ground = {
        outcome.video: [
            pose[:, [0, 2], 3] for pose in (outcome.poses.world_from_camera, outcome.poses.world_from_agent)
        ]
        for outcome in known
        if outcome.poses is not None
    }
    everything = np.concatenate([points for pair in ground.values() for points in pair])
    low, high = np.nanmin(everything, axis=0), np.nanmax(everything, axis=0)
    scale = (edge_px - 40) / max(float((high - low).max()), 0.1)
    for index, (video, pair) in enumerate(ground.items()):
        color = COLORS[index % len(COLORS)]
        for points, thickness in zip(pair, (1, 3), strict=True):
            pixel = (points - low) * scale + 20
            for start, end in itertools.pairwise(pixel):
                if np.isfinite(start).all() and np.isfinite(end).all():
                    cv2.line(
                        image,
                        tuple(np.round(start).astype(int).tolist()),
                        tuple(np.round(end).astype(int).tolist()),
                        color,
                        thickness,
                        cv2.LINE_AA,
                    )
        cv2.putText(
            image, video, (10, 18 + 16 * index), cv2.FONT_HERSHEY_SIMPLEX, 0.45, color, 1, cv2.LINE_AA
        )
    return image
