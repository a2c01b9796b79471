"""Masks from one box without depth, on synthetic scenes."""

from pathlib import Path

import numpy as np
import pytest

from pipeline.data import images, npz
from pipeline.data.clips import Clip
from pipeline.data.flow import GAPS
from pipeline.segmentation.grabcut import sharpened
from stages.segment_agent import propagation
from stages.segment_agent.config import LearningConfig
from stages.segment_agent.follow import MOTION_GAPS, follow, segment_prompt
from stages.segment_agent.footage import Footage
from stages.segment_agent.prompts import Prompt
from stages.segment_agent.propagation import MAX_LOG_ODDS, Beliefs, connected, examples, message

SIZE = (120, 160)
CELLS = (30, 40)
SHIFT_PX = 4


def _footage(folder: Path, pictures: list[np.ndarray], steps: list[np.ndarray]) -> Footage:
    """Write a recording in which the pixels of frame i move by ``steps[i]`` to the next frame."""
    for name in ("color", "depth"):
        (folder / name).mkdir()
    for frame, picture in enumerate(pictures):
        images.write_color(folder / "color" / f"{frame:06d}.jpg", picture)
    images.write_depth(folder / "depth" / "000000.exr", np.zeros((12, 16)))
    count, eye = len(pictures), np.tile(np.eye(3), (len(pictures), 1, 1))
    npz.save(
        folder / "frames.npz",
        timestamp_s=np.arange(count) / 10,
        intrinsics=eye,
        depth_intrinsics=eye,
        quality=np.ones(count, np.float32),
        gravity_known=np.array(False),
    )
    for gap in GAPS:
        for way, sign in (("fw", 1), ("bw", -1)):
            pairs = range(max(count - gap, 0))
            flow = [sign * gap * steps[first if way == "fw" else first + gap][2::4, 2::4] for first in pairs]
            npz.save(
                folder / f"flow_{gap}_{way}.npz",
                flow=np.array(flow, np.float16).reshape(len(flow), *CELLS, 2),
                confidence=np.full((len(flow), *CELLS), 255, np.uint8),
            )
    return Footage(Clip.open(folder), folder, SIZE[0])


def test_motion_separates_the_animal_from_background_in_its_box(tmp_path):
    """Half of the box shows a wall whose color is rare outside; only the animal moves."""
    rng = np.random.default_rng(0)
    picture = np.full((*SIZE, 3), (40, 110, 40), np.uint8)
    picture[30:60, 40:120] = 190, 190, 180
    animal = np.zeros(SIZE, bool)
    animal[60:90, 40:120] = animal[30:60, 95:120] = True
    picture[animal] = 60, 40, 30
    noisy = np.clip(picture + rng.normal(0, 12, picture.shape), 0, 255).astype(np.uint8)
    frames = MOTION_GAPS[0] + 1
    step = 1.5 * animal[..., None] * np.array([1, 0])
    footage = _footage(tmp_path, frames * [noisy], frames * [step])
    found = segment_prompt(footage, Prompt(0, (40, 30, 120, 90)), rng) > 0
    assert (found & animal).sum() > 0.95 * (found | animal).sum()


@pytest.fixture(scope="module")
def walk(tmp_path_factory) -> tuple[Footage, list[np.ndarray]]:
    """An animal walks to the right in front of a wall with an object of its color."""
    rng = np.random.default_rng(0)
    wall = np.clip(rng.normal((40, 110, 40), 12, (*SIZE, 3)), 0, 255).astype(np.uint8)
    coat = np.clip(rng.normal((150, 90, 50), 12, (*SIZE, 3)), 0, 255).astype(np.uint8)
    wall[8:24, 20:90] = coat[8:24, 20:90]
    pictures, masks, steps = [], [], []
    for frame in range(12):
        animal = np.zeros(SIZE, bool)
        animal[40:80, 20 + SHIFT_PX * frame : 70 + SHIFT_PX * frame] = True
        pictures.append(np.where(animal[..., None], np.roll(coat, SHIFT_PX * frame, axis=1), wall))
        masks.append(animal)
        steps.append(SHIFT_PX * animal[..., None] * np.array([1, 0]))
    return _footage(tmp_path_factory.mktemp("walk"), pictures, steps), masks


def test_outlines_are_sharpened_by_color():
    """A shifted mask moves back; what is far from its outline stays out."""
    rng = np.random.default_rng(0)
    animal, distant = np.zeros(SIZE, bool), np.zeros(SIZE, bool)
    animal[30:70, 40:120], distant[100:110, 10:30] = True, True
    colors = np.where((animal | distant)[..., None], (150, 90, 50), (40, 110, 40))
    picture = np.clip(rng.normal(colors, 12), 0, 255).astype(np.uint8)
    coarse = np.roll(animal, (2, 2), (0, 1))
    assert (sharpened(picture, coarse, rng) ^ animal).sum() < 0.2 * (coarse ^ animal).sum()
    for uniform in (np.zeros(SIZE, bool), np.ones(SIZE, bool)):
        assert (sharpened(picture, uniform, rng) == uniform).all()


@pytest.mark.parametrize("prompted", [0, 5])
def test_animal_is_tracked_forward_and_backward(walk, prompted, monkeypatch):
    monkeypatch.setattr(propagation, "STEPS", (20, 30, 30))  # enough for flat colors
    footage, masks = walk
    left = 20.0 + SHIFT_PX * prompted
    prompt = Prompt(prompted, (left, 40, left + 50, 80))
    found = list(follow(footage, prompt, LearningConfig(), np.random.default_rng(0)))
    assert len(found) == len(masks)
    for mask, true in zip(found, masks, strict=True):
        assert ((mask.labels == 255) & true).sum() > 0.9 * ((mask.labels == 255) | true).sum()


def test_labels_are_propagated_by_flow(walk):
    footage, masks = walk
    found: Beliefs = [None for _ in masks]
    found[0] = np.where(masks[0], MAX_LOG_ODDS, -MAX_LOG_ODDS).astype(np.float16)
    there = message(footage, 8, found)
    assert (there > 0)[masks[8]].mean() > 0.9 and (there < 0)[~masks[0] & ~masks[8]].mean() > 0.9
    assert not message(footage, 3, found).any(), "no flow is stored over three frames"


def test_motion_evidence_has_the_right_sign(walk):
    footage, masks = walk
    inside = masks[4].copy()
    inside[84:94, 40:80] = True
    moving = footage.moving(4, inside)
    assert (moving[masks[4]] > 0).mean() > 0.6 and (moving[masks[4]] < 0).mean() < 0.1
    assert (moving[84:94, 40:80] < 0).mean() > 0.9
    labels = examples(
        footage,
        [None, None, None, None, np.where(inside, MAX_LOG_ODDS, -MAX_LOG_ODDS)],
        4,
        5,
        footage.with_motion,
    )[0].labels
    assert (labels[84:94, 40:80] == 128).mean() > 0.9 and (labels[masks[4]] == 255).mean() > 0.6


def test_disconnected_parts_are_removed():
    inside = np.zeros(SIZE, bool)
    inside[10:30, 10:30] = inside[10:30, 50:70] = True
    carried = inside & (np.arange(SIZE[1]) < 20)
    assert (connected(inside, carried) == (inside & (np.arange(SIZE[1]) < 40))).all()
