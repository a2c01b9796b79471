"""Training crops: the turnaround's animal composited over pictures of the walk-through.

At random scales, in other light and with a soft shadow, so that neither room nor shadow is a cue.
"""

from collections.abc import Sequence

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from pipeline.segmentation.appearance import Example
from pipeline.segmentation.augmentation import LightVariation, in_other_light, scaled_crop
from pipeline.segmentation.grabcut import dilated

CROP_PX = 144
"""Side of a crop, pixels of small pictures."""
ROOM_SHARE, TURNAROUND_SHARE = 0.15, 0.25
"""Shares of crops of the room alone, and of the turnaround; in the others the animal is composited."""
SIZE_PX, ROOM_SCALE = (12.0, 110.0), (0.5, 1.5)
"""Ranges of the animal's size in a crop (root of its area) and of the scale of a room's crop."""
PLACEMENT, TURN_DEG = (0.2, 0.8), 45.0
"""Range of the chosen pixel's position in a crop, shares of its side; largest turn: tails may rise."""
UNSURE_PX = 15
"""Background this close to the turnaround's mask is ignored: tails are often missing there."""
SHADOW_ABOVE, SHADOW_ASIDE, SHADOW_BELOW, SHADOW_BLUR = (0.3, 1.0), 0.15, (-0.05, 0.25), (0.03, 0.2)
"""A shadow's cut above the feet, standard deviation of its shift sideways, range of the shift down, and range
of its blur, shares of the animal's height."""
MAX_SHADOW = 0.7
"""Largest darkening by a shadow."""
EDGE_BLUR_PX = 0.6
"""Standard deviation of the blur of composited outlines, pixels."""
BLURRED_SHARE, BLUR_PX = 0.3, (0.4, 1.2)
"""Share of blurred crops and range of the standard deviation: sessions are filmed while walking."""
LIGHT = LightVariation(exposure=0.2, white_balance=0.06, contrast=0.2, brightness=0.1, noise=0.08)
"""Another day, the same phone."""
Place = tuple[float, float]
Picture = UInt8[np.ndarray, "height width 3"]
Crop = tuple[UInt8[np.ndarray, "side side 3"], UInt8[np.ndarray, "side side"]]


def training_crop(portraits: Sequence[Example], rooms: Sequence[Picture], rng: np.random.Generator) -> Crop:
    """Return a crop of the room, of the turnaround, or of its animal composited over the room.

    Labels: 255 animal, 0 not, 128 unknown.
    """
    kind = rng.random()
    if kind < ROOM_SHARE:
        return _room_crop(rooms, rng)
    portrait = portraits[int(rng.integers(len(portraits)))]
    if kind >= ROOM_SHARE + TURNAROUND_SHARE:
        return composite(portrait, rooms, rng)
    place, scale = _placed(portrait, rng)
    unsure = (portrait.labels == 0) & dilated(portrait.labels == 255, UNSURE_PX)
    labels = np.where(unsure, np.uint8(128), portrait.labels)
    return _crop(Example(portrait.color, labels), place, scale, 128, rng, TURN_DEG)


def composite(portrait: Example, rooms: Sequence[Picture], rng: np.random.Generator) -> Crop:
    """Return a crop of a picture of the room, with the animal of a portrait and a shadow pasted into it."""
    place, scale = _placed(portrait, rng)
    color, labels = _crop(portrait, place, scale, 0, rng, TURN_DEG)
    animal = labels == 255
    shaded = _with_shadow(_room_crop(rooms, rng)[0], animal, rng)
    opacity = cv2.GaussianBlur(animal.astype(np.float32), (0, 0), EDGE_BLUR_PX)[..., None]
    pasted = opacity * color + (1 - opacity) * shaded
    return pasted.astype(np.uint8), np.where(animal, 255, 0).astype(np.uint8)


def augmented(
    crop: Crop, rng: np.random.Generator
) -> tuple[Float[Tensor, "3 side side"], UInt8[Tensor, "side side"]]:
    """Return a crop as colors -1..1, channels first, in other light, and its labels."""
    color, labels = crop
    if rng.random() < 0.5:
        color, labels = color[:, ::-1], labels[:, ::-1]
    if rng.random() < BLURRED_SHARE:
        color = cv2.GaussianBlur(np.ascontiguousarray(color), (0, 0), rng.uniform(*BLUR_PX))
    return in_other_light(color, LIGHT, rng), torch.from_numpy(np.ascontiguousarray(labels))


def _room_crop(rooms: Sequence[Picture], rng: np.random.Generator) -> Crop:
    room = rooms[int(rng.integers(len(rooms)))]
    empty = Example(room, np.zeros(room.shape[:2], np.uint8))
    place = int(rng.integers(room.shape[0])), int(rng.integers(room.shape[1]))
    return _crop(empty, place, float(np.exp(rng.uniform(*np.log(ROOM_SCALE)))), 128, rng)


def _placed(portrait: Example, rng: np.random.Generator) -> tuple[tuple[int, int], float]:
    """Return a random pixel (row, column) of the animal, and the scale for a random size."""
    inside = np.argwhere(portrait.labels == 255)
    row, column = inside[rng.integers(len(inside))].tolist()
    return (row, column), float(np.exp(rng.uniform(*np.log(SIZE_PX)))) / float(np.sqrt(len(inside)))


def _crop(
    example: Example, place: Place, scale: float, outside: int, rng: np.random.Generator, most_deg: float = 0
) -> Crop:
    """Return a scaled and turned square crop that contains a pixel (row, column), ``outside`` beyond it."""
    shift_px, turn_deg = CROP_PX * rng.uniform(*PLACEMENT, 2), rng.uniform(-most_deg, most_deg)
    return scaled_crop(example.color, example.labels, place, scale, shift_px, CROP_PX, outside, turn_deg)


def _with_shadow(
    color: UInt8[np.ndarray, "side side 3"], animal: Bool[np.ndarray, "side side"], rng: np.random.Generator
) -> Float[np.ndarray, "side side 3"]:
    """Darken the background softly around the animal's feet."""
    rows = np.flatnonzero(animal.any(1))
    if not len(rows):
        return color.astype(np.float32)
    height = float(np.ptp(rows) + 1)
    low = animal.astype(np.float32)
    low[: max(int(rows[-1] - height * rng.uniform(*SHADOW_ABOVE)), 0)] = 0
    shift = height * np.array([SHADOW_ASIDE * rng.normal(), rng.uniform(*SHADOW_BELOW)])
    low = cv2.warpAffine(low, np.array([[1, 0, shift[0]], [0, 1, shift[1]]]), animal.shape)
    low = cv2.GaussianBlur(low, (0, 0), max(1.0, height * rng.uniform(*SHADOW_BLUR)))
    return color * (1 - rng.uniform(0, MAX_SHADOW) * low / max(float(low.max()), 1e-6))[..., None]
