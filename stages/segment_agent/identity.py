"""Which of a home's animals a pixel shows: one small network, learned from all turnarounds.

`learn_identities` trains it on `Portrait`s, pictures of one animal each; crops of several are pasted over one
another, so that neither the room nor the place of a turnaround says who is shown. `Identities.who` judges a
picture, `margin` is one animal's log-odds against the others, and `of_one` keeps of what moves what is one
animal.
"""

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
from stages.segment_agent.appearance import GAIN, RATE, WEIGHT_DECAY, Appearance, aligned, normalized
from stages.segment_agent.identities.config import Config
from stages.segment_agent.windows import around

FILE, PORTRAITS = "identities.safetensors", "portraits.npz"
NOBODY = 0
"""class of pixels that show no animal; the animals follow in the order of their names"""
IGNORED = -1
LIMIT = 6.0
"""largest log-odds between two animals"""
MOVES = 3.0
"""log-odds by which what moves is rather one of the animals than nobody"""
PASTED = 0.6
"""share of crops over which another animal is pasted"""
SCALES = (0.35, 1.4)
"""how much smaller or larger than in its turnaround an animal is shown"""
TINT, EXPOSURE, CONTRAST, BRIGHTNESS = 0.08, 0.4, 0.25, 0.2
"""standard deviations of changed white balance (share, per channel), exposure (log), contrast (share) and
brightness (of -1..1) of crops: sessions are filmed in other light than turnarounds"""
GRAIN = 0.15
"""largest standard deviation of the noise of crops (of -1..1), that of an evening"""
WHOLE = 0.85
"""mean probability from which on all that moves together is one animal"""
REACH = (0.15, 0.85)
"""where in a crop a pixel of its animal lies, shares of its side"""
SEEDS = 2**31
"""seeds of the first weights"""
AROUND_PX = 80
"""of a portrait that is kept around its animal"""
BLUR_PX = 0.4
"""standard deviation of the blur of what is shown smaller, pixels of the crop: thin stripes would alias"""
SMOOTHED_SHARE = 0.08
"""side of the window over which bodies that touch are parted, as a share of the picture's height"""


@dataclass(frozen=True)
class Portrait:
    """A picture of one animal and its mask: 255 animal, 0 not, 128 unknown."""

    animal: int
    color: UInt8[np.ndarray, "height width 3"]
    labels: UInt8[np.ndarray, "height width"]

    def classes(self) -> Int[np.ndarray, "height width"]:
        """Return the class of each pixel."""
        found = np.where(self.labels == 255, self.animal + 1, NOBODY)
        return np.where(self.labels == 128, IGNORED, found)


def save_portraits(folder: Path, portraits: Sequence[Portrait]) -> None:
    """Write `portraits.npz`: each cut out with its surroundings."""
    rows = {}
    for row, each in enumerate(portraits):
        part = around(each.labels == 255, AROUND_PX)
        rows |= {f"{row:03d}/color": each.color[part], f"{row:03d}/labels": each.labels[part]}
    npz.save(folder / PORTRAITS, compress=True, animal=np.array([each.animal for each in portraits]), **rows)


def load_portraits(folder: Path) -> list[Portrait]:
    """Read what `save_portraits` wrote."""
    table = npz.load(folder / PORTRAITS)
    return [
        Portrait(int(animal), table[f"{row:03d}/color"], table[f"{row:03d}/labels"])
        for row, animal in enumerate(table["animal"])
    ]


class Identities(Appearance):
    """The network of one recording's appearance with one answer more than there are animals."""

    def __init__(self, names: Sequence[str]) -> None:
        super().__init__()
        self.names = tuple(names)
        last = self.out[0]
        assert isinstance(last, nn.Conv2d), "the convolution before the pixels are shuffled"
        answers = 4 * (len(self.names) + 1)
        self.out = nn.Sequential(nn.Conv2d(last.in_channels, answers, 3, 1, 1), nn.PixelShuffle(2))

    def logits(
        self, color: Float[Tensor, "batch 3 height width"]
    ) -> Float[Tensor, "batch class height width"]:
        """Return the classes' logits of pictures whose colours are -1..1 and sides multiples of 16."""
        return GAIN * self.out(self.trunk(color))

    @torch.no_grad()
    def who(self, color: UInt8[np.ndarray, "height width 3"]) -> Float[np.ndarray, "class height width"]:
        """Return the log-probability of nobody and of each animal for every pixel."""
        height, width = color.shape[:2]
        return F.log_softmax(self.eval().logits(aligned(color))[0, :, :height, :width], dim=0).numpy()

    def save(self, folder: Path) -> None:
        """Write `identities.safetensors`, with the names."""
        state = {name: value.contiguous() for name, value in self.state_dict().items()}
        save_file(state, folder / FILE, metadata={"names": ",".join(self.names)})

    @classmethod
    def load(cls, folder: Path) -> "Identities":
        """Read what `save` wrote."""
        with safe_open(folder / FILE, framework="pt") as file:
            network = cls(file.metadata()["names"].split(","))
            network.load_state_dict({name: file.get_tensor(name) for name in file.keys()})
        return network.eval()


def margin(
    who: Float[np.ndarray, "class height width"], animal: int, moves: float = MOVES
) -> Float[np.ndarray, "height width"]:
    """Return the log-odds that a pixel shows this animal and no other, within +-6.

    ``moves``: log-odds by which it is rather one of the animals than nobody, infinite where that is known.
    """
    others = np.delete(who, [NOBODY, animal + 1], axis=0)
    return np.clip(who[animal + 1] - np.maximum(others.max(0), who[NOBODY] - moves), -LIMIT, LIMIT)


def stranger(who: Float[np.ndarray, "class height width"]) -> Float[np.ndarray, "height width"]:
    """Return the log-odds that a pixel which moves shows none of the animals, within +-6."""
    return np.clip(who[NOBODY] - MOVES - who[1:].max(0), -LIMIT, LIMIT)


def of_one(
    moving: Bool[np.ndarray, "height width"], margins: Float[np.ndarray, "height width"]
) -> tuple[Bool[np.ndarray, "height width"], Float[np.ndarray, "height width"]]:
    """Keep of what moves what is one animal, and return its probability per pixel.

    What moves together is one animal, or another, by the mean over all of it; where it is neither surely,
    bodies touch, and the neighbourhood decides.
    """
    probability = 1 / (1 + np.exp(-margins))
    grown = cv2.dilate(moving.astype(np.uint8), np.ones((3, 3), np.uint8))
    count, part = cv2.connectedComponents(grown, connectivity=8)
    part = np.where(moving, part, 0)
    total = np.bincount(part.ravel(), minlength=count)
    mean = np.bincount(part.ravel(), probability.ravel(), count) / np.maximum(total, 1)
    side = max(3, 2 * round(SMOOTHED_SHARE * len(moving) / 2) + 1)
    weight = cv2.blur(moving.astype(np.float32), (side, side))
    near = cv2.blur(np.where(moving, probability, 0).astype(np.float32), (side, side))
    near = near / np.maximum(weight, 1e-6)
    shared = (mean[part] < WHOLE) & (mean[part] > 1 - WHOLE)
    judged = np.where(shared, near, mean[part])
    return moving & (judged > 0.5), np.where(moving, judged, 0.5).astype(np.float32)


def learn_identities(
    portraits: Sequence[Portrait], names: Sequence[str], config: Config, rng: np.random.Generator
) -> Identities:
    """Train the network on portraits of every animal."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(int(rng.integers(SEEDS)))
        network = Identities(names)
    optimizer = torch.optim.AdamW(network.parameters(), RATE, weight_decay=WEIGHT_DECAY)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, RATE, total_steps=config.steps)
    own = [[each for each in portraits if each.animal == index] for index in range(len(names))]
    for step in range(config.steps):
        network.train()
        shown = [(step + index) % len(names) for index in range(config.batch)]
        crops = [_crop(own, animal, config.crop_px, rng) for animal in shown]
        color, classes = (torch.stack(parts) for parts in zip(*crops, strict=True))
        logits = network.logits(color)
        error = F.cross_entropy(logits, classes, ignore_index=IGNORED, reduction="none")
        weight = _balance(classes, len(names) + 1)
        optimizer.zero_grad()
        (error * weight).sum().backward()
        optimizer.step()
        schedule.step()
    return network.eval()


def recognized(network: Identities, portraits: Sequence[Portrait]) -> Float[np.ndarray, "animal"]:
    """Return, per animal, the share of its pixels that are taken for it rather than for another one."""
    shares: list[list[float]] = [[] for _ in network.names]
    for each in portraits:
        inside = each.labels == 255
        if inside.any():
            own = margin(network.who(each.color), each.animal)[inside] > 0
            shares[each.animal].append(float(own.mean()))
    return np.array([np.mean(share) if share else np.nan for share in shares])


def _balance(classes: Int[Tensor, "batch height width"], count: int) -> Float[Tensor, "batch height width"]:
    """Return weights that sum to one and give every class that is there as much."""
    weight = torch.zeros(classes.shape)
    there = [index for index in range(count) if bool((classes == index).any())]
    for index in there:
        inside = classes == index
        weight[inside] = 1 / (len(there) * int(inside.sum()))
    return weight


def _crop(
    own: Sequence[Sequence[Portrait]], animal: int, side: int, rng: np.random.Generator
) -> tuple[Tensor, Tensor]:
    """Cut a square around an animal, from nearer or farther, and paste another over it now and then."""
    color, classes = _square(own[animal][int(rng.integers(len(own[animal])))], side, rng)
    if rng.random() < PASTED:
        other = int(rng.choice([index for index in range(len(own)) if index != animal]))
        above, whose = _square(own[other][int(rng.integers(len(own[other])))], side, rng)
        front = whose > NOBODY
        color, classes = np.where(front[..., None], above, color), np.where(front, whose, classes)
    if rng.random() < 0.5:
        color, classes = color[:, ::-1], classes[:, ::-1]
    tint = np.exp(EXPOSURE * rng.normal()) * (1 + TINT * rng.normal(size=(3, 1, 1)))
    shown = (normalized(color) + 1) * torch.from_numpy(tint).float() - 1
    shown = shown * (1 + CONTRAST * rng.normal()) + BRIGHTNESS * rng.normal()
    grain = rng.uniform(0, GRAIN) * rng.standard_normal(shown.shape, np.float32)
    shown = (shown + torch.from_numpy(grain)).clamp(-1, 1)
    return shown.float(), torch.from_numpy(np.ascontiguousarray(classes)).long()


def _square(
    portrait: Portrait, side: int, rng: np.random.Generator
) -> tuple[UInt8[np.ndarray, "side side 3"], Int[np.ndarray, "side side"]]:
    """Return a square of a portrait with a pixel of the animal somewhere in it, scaled by chance."""
    classes = portrait.classes()
    inside = np.argwhere(classes > NOBODY)
    row, column = inside[rng.integers(len(inside))] if len(inside) else np.array(classes.shape) // 2
    scale = float(np.exp(rng.uniform(*np.log(SCALES))))
    shift = rng.uniform(*REACH, 2) * side
    map_to = np.array([[1 / scale, 0, column - shift[0] / scale], [0, 1 / scale, row - shift[1] / scale]])
    linear, nearest = (how | cv2.WARP_INVERSE_MAP for how in (cv2.INTER_LINEAR, cv2.INTER_NEAREST))
    source, whose, size = portrait.color, classes.astype(np.int16), (side, side)
    if scale < 1:
        source = cv2.GaussianBlur(source, (0, 0), BLUR_PX / scale)
    color = cv2.warpAffine(source, map_to, size, flags=linear, borderMode=cv2.BORDER_REPLICATE)
    labels = cv2.warpAffine(whose, map_to, size, flags=nearest, borderValue=(IGNORED,))
    return color, labels.astype(np.int64)
