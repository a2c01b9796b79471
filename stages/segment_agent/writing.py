"""Write masks frame by frame, people, and the quality page: overlays, area over time, and checks."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, UInt8

from pipeline.core.progress import log, track
from pipeline.data import images, npz, plots, qa
from pipeline.data.clips import PEOPLE, Clip, Masks
from pipeline.data.qa import Check
from pipeline.geometry import rigid
from stages.segment_agent import overlap
from stages.segment_agent.config import AnimalConfig
from stages.segment_agent.masks import Segmentation
from stages.segment_agent.segmenter import Mask

LOW_CONFIDENCE, CIRCLED, MAX_DRIFT_CM = 0.75, 80, 10
"""probability below which presence is uncertain; least percent of a turnaround's frames with its animal; the
drift from which an animal as low is not known from furniture that seems to move"""
RIGHT_IOU, WRONG_IOU = 0.75, 0.6
"""mean IoU that `evaluate` requires, and an estimate below that of all good masks: on nine sessions their
estimates are at most 0.07 off, those of bad masks up to 0.14 too high and 0.22 too low"""
BLUE, DIM, TINT = (60, 90, 255), 0.6, 0.6
"""color of unknown pixels; brightness of the room, share of blue"""
SHOWN, COLUMNS, WIDTH_PX = 12, 6, 200
"""masks on the contact sheet, its columns, and the width of each"""
CAPTIONS = {
    "overlay": "masks over frames: outline green, unknown blue",
    "area": "share of the picture over time, red where the agent is out of view",
}


@dataclass
class Summary:
    """Per-frame values of masks, and a few whole masks for pictures."""

    visible: list[bool] = field(default_factory=list)
    confidence: list[float] = field(default_factory=list)
    area: list[float] = field(default_factory=list)
    shown: dict[int, np.ndarray] = field(default_factory=dict)


def write(folder: Path, clip: Clip, found: Segmentation, animal: AnimalConfig) -> list[Check]:
    """Write masks frame by frame, people, and the quality page; return its checks."""
    write_people(folder, clip, found)
    summary = write_masks(folder, track(found.masks, "masks", len(clip)), len(clip))
    if found.unknown_animals is None and not any(summary.visible):
        log("the animal was never seen: does it move here? A prompt (<recording>.prompt.toml) helps")
    return report_quality(folder, clip, summary, animal, found)


def write_masks(folder: Path, masks: Iterable[Mask], count: int) -> Summary:
    """Write ``%06d.png`` and ``masks.npz``; keep evenly spaced masks for the quality page."""
    summary, shown = Summary(), set(np.linspace(0, count - 1, SHOWN).astype(int).tolist())
    for frame, mask in enumerate(masks):
        images.write_gray(folder / f"{frame:06d}.png", mask.labels)
        summary.visible.append(mask.visible)
        summary.confidence.append(mask.confidence)
        summary.area.append(float((mask.labels == 255).mean()))
        if frame in shown:
            summary.shown[frame] = mask.labels
    confidence, area = (np.array(each, np.float32) for each in (summary.confidence, summary.area))
    npz.save(folder / "masks.npz", visible=np.array(summary.visible), confidence=confidence, area=area)
    return summary


def write_people(folder: Path, clip: Clip, found: Segmentation) -> None:
    """Write ``people.npz`` of a session with depth: where people stand on the floor (meters), and where they
    walk to, camera frame.
    """
    if found.people is not None and found.path is not None:
        feet = np.insert(np.swapaxes(found.people.axis_world, 0, 1), 1, found.people.floor_m, axis=-1)
        camera_from_world = rigid.inverse(found.path.world_from_camera)
        feet_camera = rigid.apply(camera_from_world[:, None], feet[..., None, :])[..., 0, :]
        ahead = np.insert(np.swapaxes(found.people.ahead_world, 0, 1), 1, 0.0, axis=-1)
        PEOPLE.save(
            folder / "people.npz",
            timestamp_s=clip.timestamp_s,
            feet_camera=feet_camera,
            ahead_camera=(camera_from_world[:, None, :3, :3] @ ahead[..., None])[..., 0],
            height_m=found.people.height_m,
        )


def overlay(
    color: UInt8[np.ndarray, "height width 3"], labels: UInt8[np.ndarray, "height width"]
) -> UInt8[np.ndarray, "height width 3"]:
    """Draw the agent's outline in green and unknown pixels in blue."""
    picture = color.astype(np.float32) * np.where(labels == 0, DIM, 1.0)[..., None]
    picture[labels == 128] = (1 - TINT) * picture[labels == 128] + TINT * np.array(BLUE)
    return plots.outlined(picture.astype(np.uint8), labels == 255)


def checks_of(
    summary: Summary,
    residual_m: float = np.nan,
    estimated: Float[np.ndarray, "frame"] | None = None,
    circled: bool = False,
) -> list[Check]:
    """Return the checks of masks, ``circled``: of a turnaround. Without ``estimated`` IoU: jumps of area."""
    visible, confidence = np.array(summary.visible), np.array(summary.confidence)
    unsure = confidence[np.isfinite(confidence)] < LOW_CONFIDENCE
    checks = [
        Check("agent visible", _percent(visible), "%", *((CIRCLED, 2) if circled else (2, None)), "higher"),
        Check("frames of low confidence", _percent(unsure), "%", warn=12, fail=30),
    ]
    if estimated is None:
        area = np.array(summary.area)
        jumps = np.abs(np.diff(np.log2(np.maximum(area, 1e-6)))) > 1
        share = _percent(jumps[(area[:-1] > 0) | (area[1:] > 0)])
        return [*checks, Check("area doubles, halves or is gone", share, "%", warn=6, fail=15)]
    counted = estimated[np.isfinite(estimated)]
    iou = float(counted.mean()) if len(counted) else np.nan
    return [
        *checks,
        Check("IoU estimated by free space", iou, warn=RIGHT_IOU, fail=WRONG_IOU, better="higher"),
        Check("agreement of depth pictures", 1000 * residual_m, "mm", warn=25, fail=60),
    ]


def _percent(flags: Bool[np.ndarray, "frame"]) -> float:
    return 100 * float(flags.mean()) if len(flags) else np.nan


def report_quality(
    folder: Path, clip: Clip, summary: Summary, animal: AnimalConfig, found: Segmentation
) -> list[Check]:
    """Write the quality page of written masks and return its checks; ``found`` is their segmentation.

    One of several animals may be absent.
    """
    if found.path is None or found.references is None:
        checks = checks_of(summary)
    else:
        poses, masks = found.path.world_from_camera, Masks.open(folder)
        by_space = overlap.estimate(clip, poses, found.references, masks, animal, found.shown)
        checks = checks_of(summary, found.path.residual_m, by_space, circled=found.people is None)
        checks.append(Check("drift of poses", 100 * found.references.drift_m, "cm", warn=MAX_DRIFT_CM))
    if found.unknown_animals is not None:
        checks = checks if any(summary.visible) else []
        checks.append(Check("frames with a stranger", 100 * found.unknown_animals, "%", warn=5))
    area, visible = np.array(summary.area), np.array(summary.visible)
    over_time = plots.time_series("share", area, clip.timestamp_s, ~visible)
    size = (round(WIDTH_PX * clip.color_size[0] / clip.color_size[1]), WIDTH_PX)
    tiles = [plots.resized(overlay(clip.color(frame), mask), size) for frame, mask in summary.shown.items()]
    qa.write(
        folder,
        good="the green outline hugs the animal in every frame, resting frames too",
        bad="the outline sits on furniture, flickers, or is missing while the animal is in view",
        checks=checks,
        pictures=qa.captioned(CAPTIONS, overlay=plots.grid(tiles, COLUMNS), area=over_time),
    )
    return checks
