"""What the report shows of masks: overlays, the mask's area over time, and figures with thresholds."""

from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, UInt8

from pipeline.data import plots, qa
from pipeline.data.clips import Clip
from pipeline.data.qa import Check
from stages.segment_agent.writing import Summary

FLASH_FRAMES = 3
"""an animal that comes or goes stays or is away for longer"""
LOW_CONFIDENCE = 0.75
"""probability below which presence is a guess"""
CONTRADICTED = 0.4
"""share of a mask that looks like the room, or lies where others saw a surface, that makes it doubtful"""
GREEN, BLUE = (60, 255, 90), (60, 90, 255)
CAPTIONS = {
    "overlay": "masks over frames: outline green, unknown blue",
    "area": "share of the picture over time, red where the agent is out of view",
}


def overlay(
    color: UInt8[np.ndarray, "height width 3"], labels: UInt8[np.ndarray, "height width"]
) -> UInt8[np.ndarray, "height width 3"]:
    """Draw the agent's outline in green and unknown pixels in blue."""
    picture = color.astype(np.float32) * np.where(labels == 0, 0.6, 1.0)[..., None]
    picture[labels == 128] = 0.4 * picture[labels == 128] + 0.6 * np.array(BLUE)
    return plots.outlined(picture.astype(np.uint8), labels == 255, GREEN)


def contact_sheet(
    clip: Clip, labels: dict[int, UInt8[np.ndarray, "height width"]], columns: int = 6, width_px: int = 200
) -> UInt8[np.ndarray, "height width 3"]:
    """Lay overlays of some frames out in a grid."""
    size = (round(width_px * clip.color_size[0] / clip.color_size[1]), width_px)
    tiles = [plots.resized(overlay(clip.color(frame), mask), size) for frame, mask in labels.items()]
    return plots.grid(tiles, columns)


def flicker(area: Float[np.ndarray, "frame"], visible: Bool[np.ndarray, "frame"]) -> float:
    """Return the median change of the area between neighbouring frames as a share of it."""
    both = visible[1:] & visible[:-1]
    if not both.any():
        return float("nan")
    return float(np.median(np.abs(np.diff(area))[both] / np.maximum(area[1:], area[:-1])[both]))


def area_jumps(area: Float[np.ndarray, "frame"], visible: Bool[np.ndarray, "frame"]) -> float:
    """Return the share of neighbouring frames with the agent between which its area doubles or halves."""
    both = visible[1:] & visible[:-1]
    ratio = np.maximum(area[1:], 1e-6) / np.maximum(area[:-1], 1e-6)
    return float((np.abs(np.log2(ratio)) > 1)[both].mean()) if both.any() else float("nan")


def interruptions(visible: Bool[np.ndarray, "frame"]) -> float:
    """Return how often in 100 frames the agent comes or goes for less than `FLASH_FRAMES` frames."""
    change = np.flatnonzero(np.diff(visible.astype(int)))
    return 100 * float((np.diff(change) < FLASH_FRAMES).sum()) / max(len(visible), 1)


def checks_of(summary: Summary, residual_m: float) -> list[Check]:
    """Return the figures that reveal wrong masks: implausible over time, contradicted by appearance."""
    area, visible = np.array(summary.area), np.array(summary.visible)
    confidence, contradicted = np.array(summary.confidence), np.array(summary.contradicted)
    checks = [
        Check("agent visible", _percent(visible), "%", warn=30, fail=2, better="higher"),
        Check("flicker", 100 * flicker(area, visible), "%", warn=15, fail=40),
        Check("area doubles or halves", 100 * area_jumps(area, visible), "%", warn=4, fail=12),
        Check("flashes in 100 frames", interruptions(visible), "", warn=2, fail=6),
        Check("frames of low confidence", _percent(confidence < LOW_CONFIDENCE), "%", warn=12, fail=30),
        Check("masks contradicted", _percent(contradicted[visible] > CONTRADICTED), "%", warn=6, fail=20),
    ]
    if np.isfinite(residual_m):
        checks.append(Check("agreement of depth pictures", 1000 * residual_m, "mm", warn=25, fail=60))
    return checks


def _percent(flags: Bool[np.ndarray, "frame"]) -> float:
    return 100 * float(flags.mean()) if len(flags) else float("nan")


def report_quality(
    folder: Path, clip: Clip, summary: Summary, residual_m: float, strangers: float | None = None
) -> None:
    """Write the stage's quality page; ``strangers``: share of frames with one, if several."""
    checks = checks_of(summary, residual_m)
    if strangers is not None:
        checks.append(Check("frames with a stranger", 100 * strangers, "%", warn=5))
    area, visible = np.array(summary.area), np.array(summary.visible)
    over_time = plots.time_series({"share": area}, clip.timestamp_s, absent=~visible)
    qa.write(
        folder,
        good="the green outline hugs the animal in every frame, resting frames too",
        bad="the outline sits on furniture, flickers, or is missing while the animal is in view",
        checks=checks,
        pictures=qa.captioned(CAPTIONS, overlay=contact_sheet(clip, summary.shown), area=over_time),
    )
