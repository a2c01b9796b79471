"""Judge the made world: does the animal move, does it answer people, is it seen; and draw it for the
report.
"""

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from pipeline.data import qa
from pipeline.data.qa import Check
from stages.synthesize_capture.policy import REASONS
from stages.synthesize_capture.produce import FilmedRecording
from stages.synthesize_capture.room import DEPTH_M, WIDTH_M
from stages.synthesize_capture.script import MOVING_M_S, Script
from stages.synthesize_capture.session import STEP_S, SessionTrajectories

WINDOW_S = 6.4
PIXELS_PER_M = 130
CAPTIONS = {
    "contact_sheet": "Every recording, the animal's true outline, stored depth",
    "birds_eye": "From above: the phone (blue), the animal (orange), its flights (red)",
}


@dataclass(frozen=True)
class Manner:
    """How the animal behaves in some sessions."""

    moving_windows: float
    """Share of 6.4 s windows whose mean speed is above `MOVING_M_S`."""
    flees_when_approached: float
    """Share of quick approaches within 1.5 m that it runs from within a second; NaN without approaches."""
    flees_when_left_alone: float
    """Share of seconds beyond 2.2 m, or beside someone who stands still, in which it begins to run."""


def manner(sessions: list[SessionTrajectories]) -> Manner:
    """Measure the animal's manner over sessions."""
    moving, ran, alone = [], [], []
    for lived in sessions:
        speed = lived.animal.speed()
        reach = round(WINDOW_S / STEP_S)
        moving += [
            float(speed[start : start + reach].mean() > MOVING_M_S)
            for start in range(0, max(len(speed) - reach, 1), 6)
        ]
        flee = _begins(lived.reason == REASONS.index("flee"))
        ran += [
            bool(flee[max(start - 15, 0) : start + 30].any())
            for start in np.flatnonzero(_begins(_pressed(lived)))
        ]
        away = ~_pressed(lived) & (_distance(lived) > 1.6)
        alone += [
            bool(flee[start : start + 30].any())
            for start in range(0, len(flee), 30)
            if away[max(start - 20, 0) : start + 30].all()
        ]
    return Manner(_mean(moving), _mean(ran), _mean(alone))


def report_quality(folder: Path, scripts: list[Script], made: list[FilmedRecording]) -> None:
    """Write the stage's checks and pictures into the artifact in the making."""
    shown = manner([part.session for part in scripts if part.session is not None])
    visible = _mean([part.visible_share for part in made if part.outlines.any()])
    flees, alone = shown.flees_when_approached, shown.flees_when_left_alone
    checks = [
        Check("windows in which the animal moves", shown.moving_windows, "share", 0.5, 0.4, "higher"),
        Check("quick approaches that it runs from", flees, "share", 0.6, None, "higher"),
        Check("seconds left alone in which it runs", alone, "share", 0.1, None),
        Check("frames that show the animal", visible, "share", 0.7, 0.5, "higher"),
    ]
    pictures = qa.captioned(CAPTIONS, contact_sheet=contact_sheet(made), birds_eye=birds_eye(scripts))
    good = "a lived-in room in changing light, an animal that walks, sits and runs from whoever comes close"
    bad = "an animal that never moves or is never in the picture"
    qa.write(folder, good=good, bad=bad, checks=checks, pictures=pictures)


def contact_sheet(made: list[FilmedRecording]) -> UInt8[np.ndarray, "height width 3"]:
    """Show frames of every recording, one a row: the animal's true outline in magenta, then stored depth."""
    rows = []
    for recording in made:
        pictures = []
        for color, mask in zip(recording.thumbnails, recording.outlines, strict=True):
            picture = color.copy()
            picture[cv2.morphologyEx(mask, cv2.MORPH_GRADIENT, np.ones((3, 3), np.uint8)) > 0] = (255, 0, 255)
            pictures.append(picture)
        for depth in recording.depths[1::3]:
            turbo = cv2.applyColorMap(np.clip(depth * 50, 0, 255).astype(np.uint8), cv2.COLORMAP_TURBO)[
                ..., ::-1
            ]
            turbo[depth <= 0] = 0
            pictures.append(cv2.resize(turbo, color.shape[1::-1], interpolation=cv2.INTER_NEAREST))
        rows.append(np.hstack(pictures))
    sheet = np.vstack(rows)
    return cv2.resize(sheet, None, fx=0.6, fy=0.6, interpolation=cv2.INTER_AREA)


def birds_eye(scripts: list[Script]) -> UInt8[np.ndarray, "height width 3"]:
    """Draw each recording from above: furniture grey, the phone blue, the animal orange, its flights red, a
    second animal green.
    """
    return np.hstack([_from_above(script) for script in scripts])


def _from_above(script: Script) -> UInt8[np.ndarray, "height width 3"]:
    canvas = np.full((int(DEPTH_M * PIXELS_PER_M), int(WIDTH_M * PIXELS_PER_M), 3), 250, np.uint8)
    for block in script.room.footprints():
        corners = cv2.boxPoints(((0, 0), block.size, 0.0))
        cosine, sine = np.cos(block.yaw), np.sin(block.yaw)
        turned = corners @ np.array([[cosine, -sine], [sine, cosine]]) + np.asarray(block.center)
        cv2.fillConvexPoly(
            canvas, _pixels(turned), (205, 205, 200) if block.bottom == 0 else (228, 226, 220), cv2.LINE_AA
        )
    cv2.polylines(
        canvas, [_pixels(script.world_from_camera[:, [0, 2], 3])], False, (60, 110, 220), 2, cv2.LINE_AA
    )
    for pose in script.world_from_camera[::15]:
        start = pose[[0, 2], 3]
        tail, tip = _pixels(np.stack([start, start + 0.22 * pose[[0, 2], 2]])).tolist()
        cv2.arrowedLine(canvas, tail, tip, (120, 160, 240), 1, cv2.LINE_AA, tipLength=0.3)
    if script.motion is not None:
        way = script.motion.world_from_agent[:, [0, 2], 3]
        cv2.polylines(canvas, [_pixels(way)], False, (240, 150, 40), 2, cv2.LINE_AA)
    if script.companion_motion is not None:
        way = script.companion_motion.world_from_agent[:, [0, 2], 3]
        cv2.polylines(canvas, [_pixels(way)], False, (40, 150, 60), 2, cv2.LINE_AA)
    if script.session is not None:
        course = script.session.animal.position[:, [0, 2]]
        flights = script.session.reason == REASONS.index("flee")
        for start, end in zip(
            np.flatnonzero(_begins(flights)),
            np.flatnonzero(_begins(~flights) & (np.arange(len(flights)) > 0)),
            strict=False,
        ):
            cv2.polylines(canvas, [_pixels(course[start:end])], False, (220, 40, 40), 2, cv2.LINE_AA)
    cv2.putText(canvas, script.name, (8, 22), cv2.FONT_HERSHEY_SIMPLEX, 0.6, (40, 40, 40), 1, cv2.LINE_AA)
    return canvas


def _pixels(ground: np.ndarray) -> np.ndarray:
    return np.round((ground + np.array([WIDTH_M, DEPTH_M]) / 2) * PIXELS_PER_M).astype(np.int32)


def _distance(lived: SessionTrajectories) -> np.ndarray:
    return np.linalg.norm(lived.animal.position[:, [0, 2]] - lived.observer_position, axis=-1)


def _pressed(lived: SessionTrajectories) -> np.ndarray:
    """Tell when someone comes quickly and is within 1.5 m."""
    away = lived.animal.position[:, [0, 2]] - lived.observer_position
    distance = np.linalg.norm(away, axis=-1)
    velocity = np.gradient(lived.observer_position, STEP_S, axis=0)
    closing = (velocity * away).sum(-1) / np.maximum(distance, 1e-6)
    return (closing > 0.5) & (distance < 1.5)


def _begins(flags: np.ndarray) -> np.ndarray:
    return flags & ~np.concatenate([[False], flags[:-1]])


def _mean(values: list) -> float:
    return float(np.mean(values)) if values else float("nan")
