"""Quality checks of the synthetic world: the animal moves, reacts to people, and is visible."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float

from pipeline.data import plots, qa
from pipeline.data.qa import Check, Picture
from stages.synthesize_capture.policy import REASONS, STEP_S
from stages.synthesize_capture.produce import THUMBNAILS, FilmedRecording
from stages.synthesize_capture.script import MOVING_M_S, Script
from stages.synthesize_capture.session import SessionTrajectories

WINDOW_S = 6.4


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
        speed, reach = lived.animal.speed(), round(WINDOW_S / STEP_S)
        starts = range(0, max(len(speed) - reach, 1), 6)
        moving += [float(speed[start : start + reach].mean() > MOVING_M_S) for start in starts]
        flee = _begins(lived.reason == REASONS.index("flee"))
        away = lived.animal.position[:, [0, 2]] - lived.observer_position
        pressed = _approached(away, lived)
        approaches = np.flatnonzero(_begins(pressed))
        ran += [bool(flee[max(start - 15, 0) : start + 30].any()) for start in approaches]
        left = ~pressed & (np.linalg.norm(away, axis=-1) > 1.6)
        alone += [
            bool(flee[start : start + 30].any())
            for start in range(0, len(flee), 30)
            if left[max(start - 20, 0) : start + 30].all()
        ]
    return Manner(_mean(moving), _mean(ran), _mean(alone))


def report_quality(folder: Path, scripts: list[Script], made: list[FilmedRecording]) -> None:
    """Write the stage's checks and pictures into the unfinished artifact."""
    shown = manner([part.session for part in scripts if part.session is not None])
    visible = _mean([part.visible_share for part in made if part.visible_share is not None])
    flees, alone = shown.flees_when_approached, shown.flees_when_left_alone
    checks = [
        Check("windows in which the animal moves", shown.moving_windows, "share", 0.5, 0.4, "higher"),
        Check("quick approaches that it runs from", flees, "share", 0.6, None, "higher"),
        Check("seconds left alone in which it runs", alone, "share", 0.1, None),
        Check("frames that show the animal", visible, "share", 0.7, 0.5, "higher"),
    ]
    sheet = plots.grid([picture for part in made for picture in part.thumbnails], THUMBNAILS)
    caption = "Every recording, with the animals' true outlines"
    good = "a lived-in room in changing light, an animal that walks, sits and runs from whoever comes close"
    bad = "an animal that never moves or is never in the picture"
    qa.write(folder, good=good, bad=bad, checks=checks, pictures=[Picture("contact_sheet", sheet, caption)])


def _approached(away: Float[np.ndarray, "sample 2"], lived: SessionTrajectories) -> np.ndarray:
    """Return in which samples someone approaches quickly within 1.5 m."""
    distance = np.linalg.norm(away, axis=-1)
    velocity = np.gradient(lived.observer_position, STEP_S, axis=0)
    closing = (velocity * away).sum(-1) / np.maximum(distance, 1e-6)
    return (closing > 0.5) & (distance < 1.5)


def _begins(flags: np.ndarray) -> np.ndarray:
    return flags & ~np.concatenate([[False], flags[:-1]])


def _mean(values: list) -> float:
    return float(np.mean(values)) if values else float("nan")
