"""A small segmentation network that learns the animal's appearance from a recording's first masks.

First masks come from geometry: they miss an animal that never moves, and leak where depth is poor. These
errors vary from frame to frame while the appearance stays, so a network too small to memorize the errors
learns the appearance. `learn` trains it; `Appearance.log_odds` segments a picture of any size.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TypeVar

import cv2
import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, UInt8
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from pipeline.segmentation.config import LearningConfig

ALIGNED_PX = 16
"""pictures are padded to a multiple of this"""
LOGIT_SCALE = 4.0
"""scale of the logits, so that a short training reaches confident answers"""
CONTEXT_PX = 32
"""context around a rectangle, pixels"""
MAX_LOG_ODDS = 8.0
"""log-odds of a pixel are clamped to this"""
RATE, WEIGHT_DECAY = 5e-3, 1e-3
"""peak learning rate and weight decay of AdamW"""
LABEL_TRUST_SHARE = 0.5
"""share of the steps after which contradicted labels are ignored"""
CONTRADICTION_LOG_ODDS = 4.0
"""log-odds against a label from which on it is ignored"""
ANIMAL_CROP_SHARE = 0.7
"""share of the other crops that are centered near the animal"""
HARD_NEGATIVE_SHARE = 0.2
"""share of crops around false positives, after a third of the steps"""
RESCALED_SHARE, SCALE_RANGE = 0.5, (0.25, 1.5)
"""share of rescaled crops, and the range of scales"""
ANIMAL_SHARE, MAX_GAIN = 0.05, 8.0
"""smaller animals are weighted up to this share of a crop's loss, by at most this factor"""
MIN_PX = 60
"""minimum animal pixels of an example"""
CONTRAST, BRIGHTNESS = 0.2, 0.15
"""standard deviations of the augmentation of contrast (share) and brightness (of -1..1)"""

Network = TypeVar("Network", bound=nn.Module)


@dataclass(frozen=True)
class Example:
    """A picture at working resolution (RGB first) and its labels: 255 animal, 0 not, 128 unknown."""

    color: UInt8[np.ndarray, "height width channel"]
    labels: UInt8[np.ndarray, "height width"]


class Appearance(nn.Module):
    """A U-Net of 80,000 weights from colors to the log-odds that a pixel shows the animal."""

    def __init__(self, widths: tuple[int, int, int, int] = (16, 24, 32, 48), channels: int = 3) -> None:
        super().__init__()
        first, second, third, fourth = widths
        self.down = nn.ModuleList([_block(channels, first, 2)])
        self.down.extend(nn.Sequential(_block(a, b, 2), _block(b, b)) for a, b in pairwise(widths))
        self.up = nn.ModuleList(
            [_block(fourth + third, third), _block(third + second, second), _block(second + first, first)]
        )
        self.out = nn.Sequential(nn.Conv2d(first, 4, 3, 1, 1), nn.PixelShuffle(2))

    def forward(
        self, color: Float[Tensor, "batch channel height width"]
    ) -> Float[Tensor, "batch height width"]:
        """Return log-odds of pictures whose colors are -1..1 and whose sides are multiples of 16."""
        return LOGIT_SCALE * self.out(self.trunk(color))[:, 0]

    def trunk(
        self, color: Float[Tensor, "batch channel height width"]
    ) -> Float[Tensor, "batch channel row column"]:
        """Return the features before the last layer, at half the resolution."""
        levels = [color]
        for down in self.down:
            levels.append(down(levels[-1]))
        deep = levels.pop()
        for up in self.up:
            level = levels.pop()
            wide = F.interpolate(deep, size=level.shape[-2:], mode="bilinear", align_corners=False)
            deep = up(torch.cat([wide, level], 1))
        return deep

    def log_odds_within(
        self, color: UInt8[np.ndarray, "height width 3"], rows: slice, columns: slice
    ) -> Float[np.ndarray, "rows columns"]:
        """Return `log_odds` in a rectangle of a picture, evaluated with some context only."""
        top, left = max(rows.start - CONTEXT_PX, 0), max(columns.start - CONTEXT_PX, 0)
        top, left = top - top % ALIGNED_PX, left - left % ALIGNED_PX
        found = self.log_odds(color[top : rows.stop + CONTEXT_PX, left : columns.stop + CONTEXT_PX])
        return found[rows.start - top : rows.stop - top, columns.start - left : columns.stop - left]

    @torch.no_grad()
    def log_odds(self, color: UInt8[np.ndarray, "height width channel"]) -> Float[np.ndarray, "height width"]:
        """Return the log-odds of every pixel of a picture at working resolution, within +-8."""
        height, width = color.shape[:2]
        return self.eval()(to_batch(color))[0, :height, :width].clamp(-MAX_LOG_ODDS, MAX_LOG_ODDS).numpy()


def learn(
    examples: Sequence[Example],
    options: LearningConfig,
    rng: np.random.Generator,
    *,
    room: Sequence[Example] = (),
    min_px: int = MIN_PX,
    scaled: float = RESCALED_SHARE,
) -> Appearance | None:
    """Train a network on examples, and on others that show only the ``room``; None if none shows the animal.

    Twice, hard negatives are mined from half of the examples: a striped carpet may look like a tabby.
    """
    pool = [example for example in examples if (example.labels == 255).sum() >= min_px]
    if not pool:
        return None
    pool += room
    network = initialized(lambda: Appearance(channels=pool[0].color.shape[-1]), rng)
    optimizer = torch.optim.AdamW(network.parameters(), RATE, weight_decay=WEIGHT_DECAY)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, RATE, total_steps=options.steps)
    hard_negatives = None
    for step in range(options.steps):
        if step in (options.steps // 3, 2 * options.steps // 3):
            hard_negatives = [_hard_negatives(network, example) for example in pool[::2]]
        network.train()
        crops = []
        for _ in range(options.batch):
            example, middle = _choose_crop(pool, hard_negatives, options.crop_px, rng)
            example, middle = _rescaled(example, middle, options.crop_px, scaled, rng)
            crops.append(_crop(example, middle, options.crop_px, rng))
        color, labels = (torch.stack(parts) for parts in zip(*crops, strict=True))
        found = network(color)
        contradicted = torch.where(labels == 255, -found, found) > CONTRADICTION_LOG_ODDS
        counted = (labels != 128) & ~(contradicted & (step > LABEL_TRUST_SHARE * options.steps))
        optimizer.zero_grad()
        balanced_loss(found, labels, counted).backward()
        optimizer.step()
        schedule.step()
    return fold_batch_norms(network.eval())


def initialized(build: Callable[[], Network], rng: np.random.Generator) -> Network:
    """Return a network whose initial weights ``rng`` determines."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(int(rng.integers(2**31)))
        return build()


def balanced_loss(
    found: Float[Tensor, "batch height width"],
    labels: UInt8[Tensor, "batch height width"],
    counted: Bool[Tensor, "batch height width"],
) -> Float[Tensor, ""]:
    """Return the mean cross-entropy of log-odds with labels (255: animal) where ``counted``, `balanced`."""
    loss = F.binary_cross_entropy_with_logits(found, (labels == 255).float(), reduction="none")
    weight = balanced(counted, labels == 255)
    return (loss * weight).sum() / weight.sum().clamp(min=1)


def balanced(
    counted: Bool[Tensor, "batch height width"], animal: Bool[Tensor, "batch height width"]
) -> Float[Tensor, "batch height width"]:
    """Return pixel weights: those of a small animal are raised, since the rest of a crop outnumbers them."""
    area, own = counted.sum((1, 2), keepdim=True), (counted & animal).sum((1, 2), keepdim=True)
    gain = (ANIMAL_SHARE * area / own.clamp(min=1)).clamp(1, MAX_GAIN)
    return counted * torch.where(animal, gain, 1.0)


def components(
    inside: Bool[np.ndarray, "height width"], log_odds: Float[np.ndarray, "height width"], most: int
) -> list[tuple[Bool[np.ndarray, "height width"], float]]:
    """Return up to ``most`` connected components of a mask and their evidence, the sum of log-odds, by it."""
    count, part = cv2.connectedComponents(inside.astype(np.uint8), connectivity=8)
    evidence = np.bincount(part.ravel(), np.maximum(log_odds, 0).ravel(), count)
    order = 1 + np.argsort(-evidence[1:], kind="stable")[:most]
    return [(part == number, float(evidence[number])) for number in order]


def strongest(
    inside: Bool[np.ndarray, "height width"], log_odds: Float[np.ndarray, "height width"]
) -> Bool[np.ndarray, "height width"]:
    """Return the connected component of a mask with the most evidence."""
    found = components(inside, log_odds, 1)
    return found[0][0] if found else inside


def fold_batch_norms(network: Appearance) -> Appearance:
    """Fold batch norms into convolutions, channels last: the same output in 0.4 of the time."""
    for block in [each for each in network.modules() if isinstance(each, nn.Sequential)]:
        convolution, norm = block[0], block[1]
        if isinstance(convolution, nn.Conv2d) and isinstance(norm, nn.BatchNorm2d):
            both = fuse_conv_bn_eval(convolution, norm)
            both.weight.data = both.weight.data.contiguous(memory_format=torch.channels_last)
            block[0], block[1] = both, nn.Identity()
    return network


def _hard_negatives(network: Appearance, example: Example) -> UInt8[np.ndarray, "height width"]:
    """Return sampling weights of background pixels that look like the animal: 10 x (log-odds + 2), 0..255.

    Confident detections may be the animal, so they get 0; so does all where the labeled animal is not found.
    """
    log_odds = network.log_odds(example.color)
    if (example.labels == 255).any() and (log_odds[example.labels == 255] > 0).mean() < 0.5:
        return np.zeros(log_odds.shape, np.uint8)
    mistaken = (example.labels == 0) & (log_odds < CONTRADICTION_LOG_ODDS)
    return np.where(mistaken, np.clip(10 * (log_odds + 2), 0, 255), 0).astype(np.uint8)


def _choose_crop(
    examples: Sequence[Example],
    hard_negatives: list[UInt8[np.ndarray, "height width"]] | None,
    crop_px: int,
    rng: np.random.Generator,
) -> tuple[Example, tuple[int, int]]:
    """Choose an example and a crop center (row, column): a hard negative, near the animal, or anywhere."""
    if hard_negatives is not None and rng.random() < HARD_NEGATIVE_SHARE:
        total = np.array([weight.sum(dtype=np.int64) for weight in hard_negatives])
        if total.any():
            index = int(rng.choice(len(hard_negatives), p=total / total.sum()))
            cumulative = np.cumsum(hard_negatives[index], dtype=np.int64)
            place = int(np.searchsorted(cumulative, rng.integers(cumulative[-1]), side="right"))
            return examples[2 * index], divmod(place, hard_negatives[index].shape[1])
    example = examples[int(rng.integers(len(examples)))]
    height, width = example.labels.shape
    if rng.random() >= ANIMAL_CROP_SHARE or not (example.labels == 255).any():
        return example, (int(rng.integers(height)), int(rng.integers(width)))
    inside = np.flatnonzero(example.labels == 255)
    row, column = divmod(int(inside[rng.integers(len(inside))]), width)
    reach = crop_px * 3 // 8
    return example, (row + int(rng.integers(-reach, reach)), column + int(rng.integers(-reach, reach)))


def _rescaled(
    example: Example, middle: tuple[int, int], crop_px: int, scaled: float, rng: np.random.Generator
) -> tuple[Example, tuple[int, int]]:
    """Rescale an example and its crop center with probability ``scaled``."""
    if scaled == 0 or rng.random() >= scaled:
        return example, middle
    scale = float(np.exp(rng.uniform(*np.log(SCALE_RANGE))))
    reach = math.ceil(crop_px / scale)
    top, left = (
        int(np.clip(at - reach // 2 - 1, 0, max(side - reach - 2, 0)))
        for at, side in zip(middle, example.labels.shape, strict=True)
    )
    part = np.s_[top : top + reach + 2, left : left + reach + 2]
    color, labels = example.color[part], example.labels[part]
    size = tuple(max(1, round(scale * side)) for side in labels.shape[::-1])
    color = cv2.resize(color, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
    labels = cv2.resize(labels, size, interpolation=cv2.INTER_NEAREST)
    return Example(color, labels), (round(scale * (middle[0] - top)), round(scale * (middle[1] - left)))


def _crop(
    example: Example, middle: tuple[int, int], side: int, rng: np.random.Generator
) -> tuple[Tensor, Tensor]:
    """Cut a square crop, padded where needed, and augment it: flip, contrast, brightness."""
    height, width = example.labels.shape
    top, left = middle[0] - side // 2, middle[1] - side // 2
    top, left = int(np.clip(top, 0, max(height - side, 0))), int(np.clip(left, 0, max(width - side, 0)))
    rows, columns = slice(top, top + side), slice(left, left + side)
    color, labels = example.color[rows, columns], example.labels[rows, columns]
    short = [(0, side - labels.shape[0]), (0, side - labels.shape[1])]
    color, labels = np.pad(color, [*short, (0, 0)], mode="edge"), np.pad(labels, short, constant_values=128)
    if rng.random() < 0.5:
        color, labels = color[:, ::-1], labels[:, ::-1]
    shown = normalized(color)
    shown[:3] = shown[:3] * (1 + CONTRAST * rng.normal()) + BRIGHTNESS * rng.normal()
    return shown, torch.from_numpy(labels.copy())


def to_batch(color: UInt8[np.ndarray, "height width channel"]) -> Float[Tensor, "1 channel row column"]:
    """Return a picture as network input: colors -1..1, padded to sides that are multiples of 16."""
    height, width = color.shape[:2]
    padded = np.pad(color, [(0, -height % ALIGNED_PX), (0, -width % ALIGNED_PX), (0, 0)], mode="edge")
    return normalized(padded)[None]


def normalized(color: UInt8[np.ndarray, "height width channel"]) -> Float[Tensor, "channel height width"]:
    """Scale colors to -1..1, channels first."""
    return torch.from_numpy(np.ascontiguousarray(color.transpose(2, 0, 1))).float() / 127.5 - 1


def _block(inputs: int, outputs: int, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False), nn.BatchNorm2d(outputs), nn.LeakyReLU(0.1)
    )
