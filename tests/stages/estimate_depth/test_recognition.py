"""The turnaround's animal is recognized in a session: not its shadow, and also where nothing differs."""

import cv2
import numpy as np
import pytest

from pipeline.segmentation.appearance import Example
from stages.estimate_depth import recognition
from stages.estimate_depth.foreground import color_view
from stages.estimate_depth.views import View

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


@pytest.fixture(scope="module")
def network():
    rng = np.random.default_rng(0)
    portraits, rooms = [], [texture(rng, (110, 110, 120)).astype(np.uint8) for _ in range(8)]
    for _ in range(8):
        color, inside, _ = with_animal(texture(rng, (60, 120, 60)), rng.uniform(80, 140, 2), 40)
        portraits.append(Example(color, np.where(inside, 255, 0).astype(np.uint8)))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(recognition, "STEPS", 60)
        patch.setattr(recognition, "BATCH", 4)
        return recognition.learn(portraits, rooms, rng)


def seen(color):
    gray = cv2.cvtColor(color, cv2.COLOR_RGB2GRAY)
    return color_view(color, View(gray, np.eye(3), np.eye(4), np.ones(gray.shape)))


def test_animal_is_recognized_without_its_shadow(network):
    rng = np.random.default_rng(1)
    color, inside, dark = with_animal(texture(rng, (110, 110, 120)), (150, 70), 18, shadow=0.5)
    found = recognition.recognize(network, seen(color), inside | dark, rng)
    assert (found & inside).sum() / (found | inside).sum() > 0.7
    assert (found & dark).sum() < 0.2 * dark.sum()


def test_animal_is_completed_where_the_foreground_misses_it(network):
    rng = np.random.default_rng(2)
    color, inside, _ = with_animal(texture(rng, (110, 110, 120)), (150, 70), 18)
    lower = inside & (np.arange(SIZE[0])[:, None] > 150)
    found = recognition.recognize(network, seen(color), lower, rng)
    assert (found & inside).sum() / (found | inside).sum() > 0.7


def test_nothing_is_recognized_away_from_foreground_or_in_a_shadow(network):
    rng = np.random.default_rng(3)
    color, inside, dark = with_animal(texture(rng, (110, 110, 120)), (150, 70), 18, shadow=0.5)
    nowhere = np.zeros(SIZE, bool)
    assert not recognition.recognize(network, seen(color), nowhere, rng).any()
    room = texture(rng, (110, 110, 120))
    shaded = np.where((inside | dark)[..., None], 0.5 * room, room).astype(np.uint8)
    assert recognition.recognize(network, seen(shaded), inside | dark, rng).sum() < 0.2 * inside.sum()
