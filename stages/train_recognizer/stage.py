"""The stage: turnaround, its masks and the walk-through -> the recognizer, and the quality page."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from pipeline.core.errors import InputError
from pipeline.core.progress import log
from pipeline.data import npz, plots, qa
from pipeline.data.clips import Clip, Masks
from pipeline.geometry import subsampling
from pipeline.segmentation import recognizer
from pipeline.segmentation.appearance import Appearance, Example
from stages.train_recognizer import compositing, training
from stages.train_recognizer.compositing import Crop, Picture
from stages.train_recognizer.config import Config

PORTRAITS, ROOMS = 50, 60
"""Pictures of the turnaround and of the walk-through for training."""
TEST_CROPS, TEST_ROOMS, SHOWN, COLUMNS = 60, 20, 12, 6
"""Composited crops and pictures of the room for testing; crops on the quality page, and its columns."""
RIGHT_IOU, WRONG_IOU = 0.75, 0.5
"""IoU below which the check warns and fails."""


@dataclass(frozen=True)
class Inputs:
    """What the stage reads."""

    walk: Mapping[str, Path]
    """Frames of the walk-through, by recording id."""
    frames: Mapping[str, Path]
    """Frames of the animal's turnaround, by recording id."""
    masks: Mapping[str, Path]
    """Masks of the turnaround, by recording id."""


def run(inputs: Inputs, config: Config, out: Path, *, resume: Path | None = None) -> Appearance:
    """Train the recognizer and write it into `out`. Raises MSK-008 if hardly any mask shows the animal."""
    taught, unseen = [], []
    for id, folder in inputs.frames.items():
        clip, masks = Clip.open(folder), Masks.open(inputs.masks[id])
        chosen, others = _split(len(clip), PORTRAITS)
        taught += _portraits(clip, masks, chosen)
        unseen += _portraits(clip, masks, others)
    if not (taught and unseen):
        remedy = "look at the quality page of `masks`; film the turnaround again, or give a prompt"
        what, where = "hardly any mask of the turnaround shows the animal", next(iter(inputs.masks.values()))
        raise InputError("MSK-008", what, str(where), remedy)
    walk = Clip.open(next(iter(inputs.walk.values())))
    chosen, others = _split(len(walk), ROOMS)
    rooms = [recognizer.small(walk.color(frame)) for frame in chosen]
    network, record = training.train(taught, rooms, config, resume)
    recognizer.save(network, out)
    npz.save(out / "losses.npz", loss=record.total().astype(np.float32))
    empty = [recognizer.small(walk.color(others[i])) for i in subsampling.evenly(len(others), TEST_ROOMS)]
    rng = np.random.default_rng(config.seed)
    crops = [compositing.composite(unseen[i % len(unseen)], empty, rng) for i in range(TEST_CROPS)]
    _report_quality(out, network, crops, empty)
    return network


def _split(count: int, most: int) -> tuple[list[int], list[int]]:
    """Return at most ``most`` evenly spread frames for training, three quarters of few, and the others."""
    chosen = subsampling.evenly(count, min(most, 3 * count // 4)).tolist()
    return chosen, sorted(set(range(count)) - set(chosen))


def _portraits(clip: Clip, masks: Masks, frames: list[int]) -> list[Example]:
    """Return small pictures of the turnaround with labels, 255 animal, 0 not, 128 unknown."""
    found = []
    for frame in frames:
        color = recognizer.small(clip.color(frame))
        labels = cv2.resize(masks[frame], color.shape[1::-1], interpolation=cv2.INTER_NEAREST)
        found.append(Example(color, labels))
    return [each for each in found if (each.labels == 255).any()]


def _report_quality(out: Path, network: Appearance, crops: list[Crop], rooms: list[Picture]) -> None:
    """Write the quality page: composites and rooms that were not used in training."""
    overlaps, mistaken = training.overlaps(network, crops), training.mistaken_share(network, rooms)
    log(f"recognized: IoU {overlaps.mean():.2f}; {100 * mistaken:.2f} % of the empty room")
    tiles = [plots.outlined(color, network.log_odds(color) > 0) for color, _ in crops[:SHOWN]]
    qa.write(
        out,
        good="the outline hugs the animal, small and large, and leaves its shadow out",
        bad="outlines around furniture or shadows, or only around parts of the animal",
        checks=(
            qa.Check("IoU on unseen composites", float(overlaps.mean()), "", RIGHT_IOU, WRONG_IOU, "higher"),
            qa.Check("empty room taken for the animal", 100 * mistaken, "%", warn=1.0, fail=10.0),
        ),
        pictures=qa.captioned(
            {"composites": "the turnaround's animal, pasted over the room; green: recognized"},
            composites=plots.grid(tiles, COLUMNS),
        ),
    )
