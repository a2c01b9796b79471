"""Train the recognizer on training crops, and measure it on pictures that it has not seen."""

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pipeline.core.training import FitRecord, fit
from pipeline.segmentation import appearance
from pipeline.segmentation.appearance import Appearance, Example
from pipeline.segmentation.recognizer import Recognizer
from stages.train_recognizer import compositing
from stages.train_recognizer.compositing import Crop, Picture
from stages.train_recognizer.config import Config

BATCH, SAVE_EVERY = 8, 200
"""Crops per step, and steps between checkpoints."""
WARM_UP, FIRST_RATE = 0.3, 0.04
"""Share of the steps over which the learning rate rises, and the share of its peak at which it begins."""


def one_cycle(done: float) -> float:
    """Return the factor on the learning rate: cosines up and down (Smith and Topin 2018); progress 0..1."""
    if done < WARM_UP:
        return FIRST_RATE + (1 - FIRST_RATE) * (1 - math.cos(math.pi * done / WARM_UP)) / 2
    return (1 + math.cos(math.pi * (done - WARM_UP) / (1 - WARM_UP))) / 2


def train(
    portraits: Sequence[Example], rooms: Sequence[Picture], config: Config, resume: Path | None = None
) -> tuple[Appearance, FitRecord]:
    """Train the network on portraits of the animal and pictures of the room without it.

    Checkpoints are kept in the folder ``resume``; training continues from the newest.
    """
    network = appearance.initialized(Recognizer, np.random.default_rng(config.seed))
    optimizer = torch.optim.AdamW(network.parameters(), appearance.RATE, weight_decay=appearance.WEIGHT_DECAY)

    def loss(_: int, generator: torch.Generator) -> dict[str, Float[Tensor, ""]]:
        rng = np.random.default_rng(generator.initial_seed())
        crops = [compositing.training_crop(portraits, rooms, rng) for _ in range(BATCH)]
        parts = zip(*(compositing.augmented(crop, rng) for crop in crops), strict=True)
        color, labels = (torch.stack(part) for part in parts)
        found = network(color.contiguous(memory_format=torch.channels_last))  # in three quarters of the time
        return {"segmentation": appearance.balanced_loss(found, labels, labels != 128)}

    record = fit(
        modules={"network": network},
        optimizer=optimizer,
        loss=loss,
        steps=config.steps,
        seed=config.seed,
        resume=resume,
        save_every=SAVE_EVERY,
        schedule=one_cycle,
        label="recognizer",
    )
    return network.eval(), record


def overlaps(network: Appearance, crops: Sequence[Crop]) -> Float[np.ndarray, "crop"]:
    """Return the IoU of the recognized animal with each crop's labels."""
    found = []
    for color, labels in crops:
        inside, animal = network.log_odds(color) > 0, labels == 255
        found.append((inside & animal).sum() / max((inside | animal).sum(), 1))
    return np.array(found)


def mistaken_share(network: Appearance, rooms: Sequence[Picture]) -> float:
    """Return the share of pixels of the empty room in which the animal is recognized."""
    return float(np.mean([(network.log_odds(room) > 0).mean() for room in rooms]))
