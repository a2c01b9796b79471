"""The turnaround's animal is recognized in a session: not its shadow, and also where nothing differs."""

import json
import shutil

import cv2
import numpy as np
import pytest
import torch

from pipeline.core.errors import InputError
from pipeline.data import images, npz
from pipeline.segmentation import recognizer
from pipeline.segmentation.appearance import Appearance, Example, fold_batch_norms
from pipeline.segmentation.augmentation import scaled_crop
from stages.estimate_depth import foreground
from stages.estimate_depth.foreground import color_view
from stages.estimate_depth.views import View
from stages.train_recognizer import stage, training
from stages.train_recognizer.config import Config
from tests.stages.written_frames import write_frames

SIZE = (240, 180)


def texture(rng, base):
    noise = cv2.resize(rng.normal(0, 25, (30, 24)).astype(np.float32), SIZE[::-1])
    return np.clip(np.array(base) + noise[..., None], 0, 255)


def with_animal(room, center, radius, shadow=0.0):
    """Return a picture of a striped animal with a shadow at its lower right, and both masks."""
    rows, columns = np.mgrid[: SIZE[0], : SIZE[1]]
    inside = np.hypot(rows - center[0], (columns - center[1]) / 1.5) < radius
    stripes = np.where(columns // 4 % 2, 200, 110)[..., None] * np.array([1, 0.7, 0.4])
    dark = np.hypot(rows - center[0] - radius, (columns - center[1] - radius) / 1.5) < 0.8 * radius
    shaded = room * (1 - shadow * dark)[..., None]
    return np.where(inside[..., None], stripes, shaded).astype(np.uint8), inside, dark & ~inside


def portraits_and_rooms():
    rng = np.random.default_rng(0)
    portraits, rooms = [], [texture(rng, (110, 110, 120)).astype(np.uint8) for _ in range(8)]
    for _ in range(8):
        color, inside, _ = with_animal(texture(rng, (60, 120, 60)), rng.uniform(80, 140, 2), 40)
        portraits.append(Example(color, np.where(inside, 255, 0).astype(np.uint8)))
    return portraits, rooms


@pytest.fixture(scope="module")
def network():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(training, "BATCH", 4)
        return fold_batch_norms(training.train(*portraits_and_rooms(), Config(steps=60))[0])


def seen(color):
    gray = cv2.cvtColor(color, cv2.COLOR_RGB2GRAY)
    return color_view(color, View(gray, np.eye(3), np.eye(4), np.ones(gray.shape)))


def surest(network, color, in_front):
    found = foreground.recognize(network, seen(color), in_front)
    return found[0][0] if found else np.zeros(SIZE, bool)


def test_animal_is_recognized_without_its_shadow(network):
    rng = np.random.default_rng(1)
    color, inside, dark = with_animal(texture(rng, (110, 110, 120)), (150, 70), 18, shadow=0.5)
    found = surest(network, color, inside | dark)
    assert (found & inside).sum() / (found | inside).sum() > 0.7
    assert (found & dark).sum() < 0.2 * dark.sum()


def test_animal_is_completed_where_the_foreground_misses_it(network):
    rng = np.random.default_rng(2)
    color, inside, _ = with_animal(texture(rng, (110, 110, 120)), (150, 70), 18)
    lower = inside & (np.arange(SIZE[0])[:, None] > 150)
    found = surest(network, color, lower)
    assert (found & inside).sum() / (found | inside).sum() > 0.7


def test_nothing_is_recognized_away_from_foreground_or_in_a_shadow(network):
    rng = np.random.default_rng(3)
    color, inside, dark = with_animal(texture(rng, (110, 110, 120)), (150, 70), 18, shadow=0.5)
    nowhere = np.zeros(SIZE, bool)
    assert not foreground.recognize(network, seen(color), nowhere)
    room = texture(rng, (110, 110, 120))
    shaded = np.where((inside | dark)[..., None], 0.5 * room, room).astype(np.uint8)
    assert surest(network, shaded, inside | dark).sum() < 0.2 * inside.sum()


def test_small_animal_has_finer_outlines_in_magnified_pictures(network):
    rng, found = np.random.default_rng(4), {Appearance: [], recognizer.Recognizer: []}
    for _ in range(6):
        color, inside, _ = with_animal(texture(rng, (110, 110, 120)), rng.uniform(60, 120, 2), 9)
        for kind, overlaps in found.items():
            shown = kind.log_odds(network, color) > 0
            overlaps.append((shown & inside).sum() / (shown | inside).sum())
    assert np.mean(found[recognizer.Recognizer]) > np.mean(found[Appearance]) + 0.02


def test_an_animal_close_to_the_camera_is_recognized_as_a_whole(monkeypatch):
    """By scales at which it is not larger than in training; a small one beside it by the finer ones."""

    def of_size(self, color):
        count, part, boxes, _ = cv2.connectedComponentsWithStats((color[..., 0] > 128).astype(np.uint8))
        fits = [index for index in range(1, count) if 20 < np.sqrt(boxes[index, 4]) < 120]
        return np.where(np.isin(part, fits), 6.0, -6.0).astype(np.float32)

    monkeypatch.setattr(Appearance, "log_odds", of_size)
    color = np.zeros((240, 320, 3), np.uint8)
    color[40:140, 40:140] = color[200:212, 280:292] = 255
    found = recognizer.Recognizer().log_odds(color) > 0
    assert (found == (color[..., 0] > 0)).mean() > 0.99
    assert found[206, 286], "12 pixels"


def test_animals_are_turned_about_the_chosen_pixel():
    rng = np.random.default_rng(5)
    color = rng.integers(0, 256, (61, 61, 3), np.uint8)
    labels, middle, side = np.where(color[..., 0] > 128, 255, 0).astype(np.uint8), np.array([30, 30]), 61
    for turns in range(4):
        turned = scaled_crop(color, labels, (30, 30), 1.0, middle, side, 128, 90.0 * turns)
        np.testing.assert_array_equal(turned[0], np.rot90(color, -turns))
        np.testing.assert_array_equal(turned[1], np.rot90(labels, -turns))


def write_recording(folder, pictures, masks=()):
    """Write `frames` of pictures, and `masks`."""
    write_frames(folder, pictures, np.zeros((24, 18)))
    (folder / "masks").mkdir()
    for frame, labels in enumerate(masks):
        images.write_gray(folder / f"masks/{frame:06d}.png", labels)
    visible = np.array([(labels == 255).any() for labels in masks], bool)
    npz.save(folder / "masks/masks.npz", visible=visible, confidence=np.ones(len(masks), np.float32))
    return {"v000": folder}


def stage_inputs(folder, portraits):
    walk = write_recording(folder / "walk", portraits_and_rooms()[1])
    labels = [each.labels for each in portraits]
    turnaround = write_recording(folder / "turnaround", [each.color for each in portraits], labels)
    (folder / "out").mkdir()
    return stage.Inputs(walk, turnaround, {"v000": turnaround["v000"] / "masks"})


def test_stage_writes_a_network_and_how_good_it_is(tmp_path):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(training, "BATCH", 4)
        patch.setattr(stage, "PORTRAITS", 6)
        patch.setattr(stage, "ROOMS", 6)
        portraits = portraits_and_rooms()[0]
        trained = stage.run(stage_inputs(tmp_path, portraits), Config(steps=60), tmp_path / "out")
    read = recognizer.load(tmp_path / "out")
    color = portraits[0].color
    np.testing.assert_allclose(read.log_odds(color), trained.log_odds(color), atol=1e-3)
    assert len(npz.load(tmp_path / "out/losses.npz")["loss"]) == 60
    overlap, mistaken = json.loads((tmp_path / "out/qa.json").read_text())["checks"]
    assert overlap["value"] > 0.6 and mistaken["value"] < 2


@pytest.mark.parametrize("count", [4, 5, 50, 60, 66, 67, 400])
def test_short_turnarounds_leave_pictures_for_the_test(count):
    chosen, others = stage._split(count, stage.PORTRAITS)
    assert sorted(chosen + others) == list(range(count)) and len(others) >= count // 4
    assert len(chosen) == min(stage.PORTRAITS, 3 * count // 4)


@pytest.mark.parametrize("shown", [(), range(1)])
def test_turnaround_without_masks_is_refused(tmp_path, shown):
    blank = np.zeros(SIZE, np.uint8)
    few = [
        each if i in shown else Example(each.color, blank) for i, each in enumerate(portraits_and_rooms()[0])
    ]
    with pytest.raises(InputError, match="MSK-008"):
        stage.run(stage_inputs(tmp_path, few), Config(steps=2), tmp_path / "out")


def test_interrupted_training_continues_to_the_same_weights(tmp_path, monkeypatch):
    monkeypatch.setattr(training, "BATCH", 1)
    monkeypatch.setattr(training, "SAVE_EVERY", 2)
    whole, _ = training.train(*portraits_and_rooms(), Config(steps=6), tmp_path / "whole")
    (tmp_path / "again").mkdir()
    shutil.copy(tmp_path / "whole/step000000004.pt", tmp_path / "again")
    again, record = training.train(*portraits_and_rooms(), Config(steps=6), tmp_path / "again")
    assert len(record.total()) == 6
    for name, value in whole.state_dict().items():
        assert torch.equal(value, again.state_dict()[name]), name
