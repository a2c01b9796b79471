"""Quality page of masks: overlays, the mask's area over time, and checks with thresholds."""

from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, UInt8

from pipeline.data import plots, qa
from pipeline.data.clips import Clip, Masks
from pipeline.data.qa import Check
from stages.segment_agent import overlap
from stages.segment_agent.config import AnimalConfig
from stages.segment_agent.masks import Segmentation
from stages.segment_agent.writing import Summary

LOW_CONFIDENCE = 0.75
"""probability below which presence is uncertain"""
RIGHT_IOU, WRONG_IOU = 0.75, 0.6
"""mean IoU that `evaluate` requires, and an estimate below that of all good masks: on nine sessions their
estimates are at most 0.07 off, those of bad masks up to 0.14 too high and 0.22 too low"""
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


def area_jumps(area: Float[np.ndarray, "frame"]) -> float:
    """Return the share of frame steps at which the area more than doubles, halves, starts or ends."""
    both = np.maximum(np.stack([area[:-1], area[1:]]), 1e-6)
    shown = (area[:-1] > 0) | (area[1:] > 0)
    return (
        float((np.abs(np.diff(np.log2(both), axis=0)[0]) > 1)[shown].mean()) if shown.any() else float("nan")
    )


def checks_of(
    summary: Summary, residual_m: float = np.nan, estimated: Float[np.ndarray, "frame"] | None = None
) -> list[Check]:
    """Return the checks of masks; without an ``estimated`` IoU, jumps of the area over time."""
    visible, confidence = np.array(summary.visible), np.array(summary.confidence)
    unsure = confidence[np.isfinite(confidence)] < LOW_CONFIDENCE
    checks = [
        Check("agent visible", _percent(visible), "%", fail=2, better="higher"),
        Check("frames of low confidence", _percent(unsure), "%", warn=12, fail=30),
    ]
    if estimated is None:
        jumps = 100 * area_jumps(np.array(summary.area))
        return [*checks, Check("area doubles, halves or is gone", jumps, "%", warn=6, fail=15)]
    counted = estimated[np.isfinite(estimated)]
    iou = float(counted.mean()) if len(counted) else np.nan
    return [
        *checks,
        Check("IoU estimated by free space", iou, warn=RIGHT_IOU, fail=WRONG_IOU, better="higher"),
        Check("agreement of depth pictures", 1000 * residual_m, "mm", warn=25, fail=60),
    ]


def _percent(flags: Bool[np.ndarray, "frame"]) -> float:
    return 100 * float(flags.mean()) if len(flags) else float("nan")


def report_quality(
    folder: Path, clip: Clip, summary: Summary, animal: AnimalConfig, found: Segmentation | None
) -> None:
    """Write the quality page of written masks; ``found``: their segmentation, None for foundation models."""
    if found is None or found.path is None or found.references is None:
        checks = checks_of(summary)
    else:
        poses, masks = found.path.world_from_camera, Masks.open(folder)
        by_space = overlap.estimate(clip, poses, found.references, masks, animal, found.shown)
        checks = checks_of(summary, found.path.residual_m, by_space)
    if found is not None and found.unknown_animals is not None:
        checks.append(Check("frames with a stranger", 100 * found.unknown_animals, "%", warn=5))
    area, visible = np.array(summary.area), np.array(summary.visible)
    over_time = plots.time_series({"share": area}, clip.timestamp_s, absent=~visible)
    qa.write(
        folder,
        good="the green outline hugs the animal in every frame, resting frames too",
        bad="the outline sits on furniture, flickers, or is missing while the animal is in view",
        checks=checks,
        pictures=qa.captioned(CAPTIONS, overlay=contact_sheet(clip, summary.shown), area=over_time),
    )
