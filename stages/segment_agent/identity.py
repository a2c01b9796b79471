"""Per-pixel classification of a home's animals by one small network, trained on all turnarounds.

`learn_identities` trains it on `Portrait`s, pictures of one animal each, with copy-paste augmentation so that
the background is no cue. `Identities.predict` classifies a picture, `identity_log_odds` compares
one animal with the others, and `select_animal` keeps the moving pixels that show one animal.
"""

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int, UInt8
from safetensors import safe_open
from safetensors.torch import save_file
from torch import Tensor, nn

from pipeline.data import npz
from pipeline.segmentation import appearance
from pipeline.segmentation.appearance import Appearance, Example, to_batch
from pipeline.segmentation.augmentation import LightVariation, in_other_light, scaled_crop
from pipeline.segmentation.config import LearningConfig
from stages.segment_agent.identities.config import Config

FILE, PORTRAITS = "identities.safetensors", "portraits.npz"
BACKGROUND = 0
"""class of pixels without animals; the animals follow in the order of their names"""
IGNORED = -1
MAX_LOG_ODDS = 6.0
"""log-odds between two animals are clamped to this"""
MOTION_LOG_ODDS = 3.0
"""prior log-odds that a moving pixel is an animal rather than background"""
PASTE_SHARE = 0.6
"""share of crops into which another animal is pasted"""
SCALE_RANGE = (0.12, 1.4)
"""range of scales of crops relative to the turnaround, which is filmed from nearby"""
LIGHT = LightVariation(exposure=0.4, white_balance=0.08, contrast=0.25, brightness=0.2, noise=0.15)
"""sessions are filmed in other light than turnarounds, some in the evening"""
COHERENT = 0.85
"""mean probability above which a connected component is one animal"""
PLACEMENT = (0.15, 0.85)
"""range of the animal pixel's position in a crop, shares of its side"""
MARGIN_PX = 80
"""margin kept around the animal of a portrait"""
WINDOW_SHARE = 0.08
"""side of the window over which touching bodies are separated, as a share of the picture's height"""


@dataclass(frozen=True)
class Portrait(Example):
    """An example that shows one animal, the index of its name."""

    animal: int


def save_portraits(folder: Path, portraits: Sequence[Portrait]) -> None:
    """Write `portraits.npz`: each cropped around its animal."""
    rows = {}
    for row, each in enumerate(portraits):
        left, top, width, height = cv2.boundingRect((each.labels == 255).astype(np.uint8))
        bounds = (top, top + height - 1), (left, left + width - 1)
        part = tuple(slice(max(low - MARGIN_PX, 0), high + MARGIN_PX) for low, high in bounds)
        rows |= {f"{row:03d}/color": each.color[part], f"{row:03d}/labels": each.labels[part]}
    npz.save(folder / PORTRAITS, compress=True, animal=np.array([each.animal for each in portraits]), **rows)


def load_portraits(folder: Path) -> list[Portrait]:
    """Read what `save_portraits` wrote."""
    table = npz.load(folder / PORTRAITS)
    return [
        Portrait(table[f"{row:03d}/color"], table[f"{row:03d}/labels"], int(animal))
        for row, animal in enumerate(table["animal"])
    ]


class Identities(Appearance):
    """`Appearance` with one output class per animal, and one for the background."""

    def __init__(self, names: Sequence[str]) -> None:
        super().__init__()
        self.names = tuple(names)
        last = self.out[0]
        assert isinstance(last, nn.Conv2d), "the convolution before the pixels are shuffled"
        channels = 4 * (len(self.names) + 1)
        self.out = nn.Sequential(nn.Conv2d(last.in_channels, channels, 3, 1, 1), nn.PixelShuffle(2))

    def logits(
        self, color: Float[Tensor, "batch 3 height width"]
    ) -> Float[Tensor, "batch class height width"]:
        """Return the classes' logits of pictures whose colors are -1..1 and sides multiples of 16."""
        return appearance.LOGIT_SCALE * self.out(self.trunk(color))

    @torch.no_grad()
    def predict(self, color: UInt8[np.ndarray, "height width 3"]) -> Float[np.ndarray, "class height width"]:
        """Return the log-probability of background and of each animal for every pixel."""
        height, width = color.shape[:2]
        return F.log_softmax(self.eval().logits(to_batch(color))[0, :, :height, :width], dim=0).numpy()

    def save(self, folder: Path) -> None:
        """Write `identities.safetensors` with the names as metadata."""
        state = {name: value.contiguous() for name, value in self.state_dict().items()}
        save_file(state, folder / FILE, metadata={"names": ",".join(self.names)})

    @classmethod
    def load(cls, folder: Path) -> "Identities":
        """Read what `save` wrote."""
        with safe_open(folder / FILE, framework="pt") as file:
            network = cls(file.metadata()["names"].split(","))
            network.load_state_dict({name: file.get_tensor(name) for name in file.keys()})
        return network.eval()


def identity_log_odds(
    log_prob: Float[np.ndarray, "class height width"], animal: int, motion_log_odds: float = MOTION_LOG_ODDS
) -> Float[np.ndarray, "height width"]:
    """Return the log-odds that a pixel shows this animal and no other, within +-6.

    ``motion_log_odds``: prior of an animal against background, infinite where one is known to be there.
    """
    others = np.delete(log_prob, [BACKGROUND, animal + 1], axis=0)
    best_other = np.maximum(others.max(0), log_prob[BACKGROUND] - motion_log_odds)
    return np.clip(log_prob[animal + 1] - best_other, -MAX_LOG_ODDS, MAX_LOG_ODDS)


def stranger_log_odds(log_prob: Float[np.ndarray, "class height width"]) -> Float[np.ndarray, "height width"]:
    """Return the log-odds that a moving pixel shows none of the animals, within +-6."""
    return np.clip(log_prob[BACKGROUND] - MOTION_LOG_ODDS - log_prob[1:].max(0), -MAX_LOG_ODDS, MAX_LOG_ODDS)


def select_animal(
    moving: Bool[np.ndarray, "height width"], log_odds: Float[np.ndarray, "height width"]
) -> tuple[Bool[np.ndarray, "height width"], Float[np.ndarray, "height width"]]:
    """Return the moving pixels that show one animal, and their probability (0.5 elsewhere).

    A connected component is classified by its mean probability; if that is ambiguous, bodies touch, and the
    mean over a local window decides.
    """
    probability = 1 / (1 + np.exp(-log_odds))
    dilated = cv2.dilate(moving.astype(np.uint8), np.ones((3, 3), np.uint8))
    count, component = cv2.connectedComponents(dilated, connectivity=8)
    component = np.where(moving, component, 0)
    total = np.bincount(component.ravel(), minlength=count)
    mean = np.bincount(component.ravel(), probability.ravel(), count) / np.maximum(total, 1)
    side = max(3, 2 * round(WINDOW_SHARE * len(moving) / 2) + 1)
    weight = cv2.blur(moving.astype(np.float32), (side, side))
    near = cv2.blur(np.where(moving, probability, 0).astype(np.float32), (side, side))
    near = near / np.maximum(weight, 1e-6)
    shared = (mean[component] < COHERENT) & (mean[component] > 1 - COHERENT)
    decided = np.where(shared, near, mean[component])
    return moving & (decided > 0.5), np.where(moving, decided, 0.5).astype(np.float32)


def learn_identities(
    portraits: Sequence[Portrait],
    names: Sequence[str],
    config: Config | LearningConfig,
    rng: np.random.Generator,
    start: Identities | None = None,
) -> Identities:
    """Train the network on portraits of every animal, from scratch or from a copy of another one."""
    network = copy.deepcopy(start) or appearance.initialized(lambda: Identities(names), rng)
    optimizer = torch.optim.AdamW(network.parameters(), appearance.RATE, weight_decay=appearance.WEIGHT_DECAY)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, appearance.RATE, total_steps=config.steps)
    own = [[each for each in portraits if each.animal == index] for index in range(len(names))]
    for step in range(config.steps):
        network.train()
        shown = [(step + index) % len(names) for index in range(config.batch)]
        crops = [_composited_crop(own, animal, config.crop_px, rng) for animal in shown]
        color, classes = (torch.stack(parts) for parts in zip(*crops, strict=True))
        logits = network.logits(color)
        error = F.cross_entropy(logits, classes, ignore_index=IGNORED, reduction="none")
        weight = _weights(classes, len(names) + 1)
        optimizer.zero_grad()
        (error * weight).sum().backward()
        optimizer.step()
        schedule.step()
    return network.eval()


def recognition_rates(network: Identities, portraits: Sequence[Portrait]) -> Float[np.ndarray, "animal"]:
    """Return each animal's recall: the share of its pixels with a positive margin."""
    shares: list[list[float]] = [[] for _ in network.names]
    for each in portraits:
        inside = each.labels == 255
        if inside.any():
            own = identity_log_odds(network.predict(each.color), each.animal)[inside] > 0
            shares[each.animal].append(float(own.mean()))
    return np.array([np.mean(share) if share else np.nan for share in shares])


def _weights(classes: Int[Tensor, "batch height width"], count: int) -> Float[Tensor, "batch height width"]:
    """Return pixel weights that sum to one, equally distributed over the classes present."""
    weight = torch.zeros(classes.shape)
    there = [index for index in range(count) if bool((classes == index).any())]
    for index in there:
        inside = classes == index
        weight[inside] = 1 / (len(there) * int(inside.sum()))
    return weight


def _composited_crop(
    own: Sequence[Sequence[Portrait]], animal: int, side: int, rng: np.random.Generator
) -> tuple[Tensor, Tensor]:
    """Return a random crop of an animal, sometimes with another pasted over it, with augmented colors."""
    color, classes = _random_crop(own[animal][int(rng.integers(len(own[animal])))], side, rng)
    if rng.random() < PASTE_SHARE:
        other = int(rng.choice([index for index in range(len(own)) if index != animal]))
        pasted, pasted_classes = _random_crop(own[other][int(rng.integers(len(own[other])))], side, rng)
        front = pasted_classes > BACKGROUND
        color, classes = np.where(front[..., None], pasted, color), np.where(front, pasted_classes, classes)
    if rng.random() < 0.5:
        color, classes = color[:, ::-1], classes[:, ::-1]
    shown = in_other_light(color, LIGHT, rng)
    return shown, torch.from_numpy(np.ascontiguousarray(classes)).long()


def _random_crop(
    portrait: Portrait, side: int, rng: np.random.Generator
) -> tuple[UInt8[np.ndarray, "side side 3"], Int[np.ndarray, "side side"]]:
    """Return a randomly scaled square crop of a portrait that contains a pixel of the animal."""
    classes = np.where(portrait.labels == 255, portrait.animal + 1, BACKGROUND)
    classes = np.where(portrait.labels == 128, IGNORED, classes).astype(np.int16)
    inside = np.argwhere(classes > BACKGROUND)
    row, column = inside[rng.integers(len(inside))] if len(inside) else np.array(classes.shape) // 2
    scale = float(np.exp(rng.uniform(*np.log(SCALE_RANGE))))
    shift = rng.uniform(*PLACEMENT, 2) * side
    crop = scaled_crop(portrait.color, classes, (row, column), scale, shift, side, IGNORED)
    return crop[0], crop[1].astype(np.int64)
