"""Recognize the turnaround's animal in a session without depth.

A difference from the walk-through is not always the animal: its shadow differs too, and where the map has
holes nothing does. A small network learns the animal from its turnaround, composited over pictures of the
walk-through at random scales and with a soft shadow, so that neither room nor shadow is a cue.
"""

from collections.abc import Sequence

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from pipeline.core.progress import track
from pipeline.data.clips import Clip, Masks
from pipeline.geometry import subsampling
from pipeline.segmentation import appearance
from pipeline.segmentation.appearance import Appearance, Example
from pipeline.segmentation.augmentation import LightVariation, in_other_light, scaled_crop
from pipeline.segmentation.grabcut import dilated, sharpened
from stages.estimate_depth import views
from stages.estimate_depth.foreground import ColorView

PORTRAITS, ROOMS = 50, 60
"""Pictures of the turnaround and of the walk-through."""
STEPS, BATCH, CROP_PX = 1600, 8, 144
"""Training steps, crops per step, and side of a crop, pixels of small pictures."""
ROOM_SHARE, TURNAROUND_SHARE = 0.15, 0.25
"""Shares of crops of the room alone, and of the turnaround; in the others the animal is composited."""
SIZE_PX, ROOM_SCALE = (12.0, 110.0), (0.5, 1.5)
"""Ranges of the animal's size in a crop (root of its area) and of the scale of a room's crop."""
PLACEMENT = (0.2, 0.8)
"""Range of the chosen pixel's position in a crop, shares of its side."""
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
REACH_PX = 12
"""The animal is at most this far from foreground, pixels of small pictures: parts of it resemble the room."""
Crop = tuple[UInt8[np.ndarray, "side side 3"], UInt8[np.ndarray, "side side"]]


def rooms_of(walk: Clip) -> list[UInt8[np.ndarray, "height width 3"]]:
    """Return evenly spread small pictures of the walk-through."""
    return [views.small(walk.color(frame)) for frame in subsampling.evenly(len(walk), ROOMS).tolist()]


def portraits_of(turnaround: Clip, masks: Masks) -> list[Example]:
    """Return evenly spread small pictures of the turnaround with labels: 255 animal, 0 not, 128 unknown."""
    found = []
    for frame in subsampling.evenly(len(turnaround), PORTRAITS).tolist():
        color = views.small(turnaround.color(frame))
        labels = cv2.resize(masks[frame], color.shape[1::-1], interpolation=cv2.INTER_NEAREST)
        found.append(Example(color, labels))
    return [each for each in found if (each.labels == 255).any()]


def learn(
    portraits: Sequence[Example],
    rooms: Sequence[UInt8[np.ndarray, "height width 3"]],
    rng: np.random.Generator,
) -> Appearance:
    """Train the network on portraits of the animal and pictures of the room without it."""
    empty = [Example(room, np.zeros(room.shape[:2], np.uint8)) for room in rooms]
    network = appearance.initialized(Appearance, rng)
    optimizer = torch.optim.AdamW(network.parameters(), appearance.RATE, weight_decay=appearance.WEIGHT_DECAY)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, appearance.RATE, total_steps=STEPS)
    for _ in track(range(STEPS), "learning the animal's appearance"):
        network.train()
        crops = [_augmented(_training_crop(portraits, empty, rng), rng) for _ in range(BATCH)]
        color, labels = (torch.stack(parts) for parts in zip(*crops, strict=True))
        optimizer.zero_grad()
        appearance.balanced_loss(network(color), labels, labels != 128).backward()
        optimizer.step()
        schedule.step()
    return appearance.fold_batch_norms(network.eval())


def recognize(
    network: Appearance,
    target: ColorView,
    in_front: Bool[np.ndarray, "height width"],
    rng: np.random.Generator,
) -> Bool[np.ndarray, "height width"]:
    """Return the animal's mask: of what is recognized near foreground, the part with the most evidence."""
    log_odds = network.log_odds(target.color)
    near = (log_odds > 0) & dilated(in_front, REACH_PX)
    count, part = cv2.connectedComponents(near.astype(np.uint8), connectivity=8)
    if count < 2:
        return np.zeros(in_front.shape, bool)
    evidence = np.bincount(part.ravel(), np.maximum(log_odds, 0).ravel(), count)
    return sharpened(target.color, part == 1 + evidence[1:].argmax(), rng)


def _training_crop(portraits: Sequence[Example], empty: Sequence[Example], rng: np.random.Generator) -> Crop:
    """Return a crop of the room, of the turnaround, or of its animal composited over the room."""
    room = empty[int(rng.integers(len(empty)))]
    place = int(rng.integers(len(room.labels))), int(rng.integers(room.labels.shape[1]))
    background = _crop(room, place, float(np.exp(rng.uniform(*np.log(ROOM_SCALE)))), 128, rng)
    kind = rng.random()
    if kind < ROOM_SHARE:
        return background
    portrait = portraits[int(rng.integers(len(portraits)))]
    inside = np.argwhere(portrait.labels == 255)
    row, column = inside[rng.integers(len(inside))].tolist()
    scale = float(np.exp(rng.uniform(*np.log(SIZE_PX)))) / float(np.sqrt(len(inside)))
    if kind < ROOM_SHARE + TURNAROUND_SHARE:
        unsure = (portrait.labels == 0) & dilated(portrait.labels == 255, UNSURE_PX)
        labels = np.where(unsure, np.uint8(128), portrait.labels)
        return _crop(Example(portrait.color, labels), (row, column), scale, 128, rng)
    color, labels = _crop(portrait, (row, column), scale, 0, rng)
    animal = labels == 255
    shaded = _with_shadow(background[0], animal, rng)
    opacity = cv2.GaussianBlur(animal.astype(np.float32), (0, 0), EDGE_BLUR_PX)[..., None]
    composite = opacity * color + (1 - opacity) * shaded
    return composite.astype(np.uint8), np.where(animal, 255, 0).astype(np.uint8)


def _crop(
    example: Example, place: tuple[float, float], scale: float, outside: int, rng: np.random.Generator
) -> Crop:
    """Return a scaled square crop that contains a pixel (row, column); labels are ``outside`` beyond it."""
    shift_px = CROP_PX * rng.uniform(*PLACEMENT, 2)
    return scaled_crop(example.color, example.labels, place, scale, shift_px, CROP_PX, outside)


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


def _augmented(crop: Crop, rng: np.random.Generator) -> tuple[Tensor, Tensor]:
    """Return a crop as colors -1..1, channels first, in other light, and its labels."""
    color, labels = crop
    if rng.random() < 0.5:
        color, labels = color[:, ::-1], labels[:, ::-1]
    if rng.random() < BLURRED_SHARE:
        color = cv2.GaussianBlur(np.ascontiguousarray(color), (0, 0), rng.uniform(*BLUR_PX))
    return in_other_light(color, LIGHT, rng), torch.from_numpy(np.ascontiguousarray(labels))
