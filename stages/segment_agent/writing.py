"""Write masks frame by frame and collect the per-frame table and masks for the quality page."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from pipeline.data import images, npz
from pipeline.data.clips import PEOPLE, Clip
from stages.segment_agent.masks import Segmentation
from stages.segment_agent.segmenter import Mask


@dataclass
class Summary:
    """Per-frame values of masks, and a few whole masks for pictures."""

    visible: list[bool] = field(default_factory=list)
    confidence: list[float] = field(default_factory=list)
    area: list[float] = field(default_factory=list)
    shown: dict[int, np.ndarray] = field(default_factory=dict)


def write(folder: Path, masks: Iterable[Mask], count: int, pictures: int = 12) -> Summary:
    """Write ``%06d.png`` and ``masks.npz``; keep ``pictures`` evenly spaced masks for the quality page."""
    summary, shown = Summary(), set(np.linspace(0, count - 1, pictures).astype(int).tolist())
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
    """Write ``people.npz`` of a session with depth."""
    if found.people is not None and found.path is not None:
        feet_camera = found.people.feet_in_camera(found.path.world_from_camera)
        time_s, height_m = clip.timestamp_s, found.people.height_m
        PEOPLE.save(folder / "people.npz", timestamp_s=time_s, feet_camera=feet_camera, height_m=height_m)
