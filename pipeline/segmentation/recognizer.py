"""The network that recognizes the turnaround's animal in sessions without depth: file and pictures."""

import math
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from numpy import ndarray
from safetensors.torch import load_file, save_file
from scipy.special import expit, logit

from pipeline.segmentation.appearance import Appearance, fold_batch_norms

FILE = "recognizer.safetensors"
SHORTER_PX = 240
"""Shorter side of the pictures that it sees at scale 1, pixels."""
SCALES = (0.5, 1.0, 2.0, 3.0)
"""Scales at which it recognizes: the coarser have more context, and a session's animal is small."""
LARGEST_PX, AROUND_PX = 165, 25
"""Largest animal that a scale is used for (root of its area): half again as large as in training; and how far
around it the scales are chosen for it, pixels at scale 1."""

_ENLARGED, _REDUCED = (cv2.INTER_CUBIC, cv2.INTER_AREA), (cv2.INTER_AREA, cv2.INTER_LINEAR)


class Recognizer(Appearance):
    """A network that recognizes an animal by its mean probability over several scales of a picture."""

    def log_odds(self, color: UInt8[ndarray, "height width channel"]) -> Float[ndarray, "height width"]:
        """Return the log-odds of every pixel of a picture from `small`, within +-8.

        Around what the two coarsest scales show, those are used that suit its size, elsewhere all but one.
        """
        size, found = color.shape[1::-1], []
        for scale in SCALES:
            there, back = _ENLARGED if scale > 1 else _REDUCED
            scaled = cv2.resize(color, None, fx=scale, fy=scale, interpolation=there)
            found.append(cv2.resize(super().log_odds(scaled), size, interpolation=back))
        probability = expit(found)
        mean, coarse = probability[1:].mean(0), (probability[:2].mean(0) > 0.5).astype(np.uint8)
        _, _, boxes, _ = cv2.connectedComponentsWithStats(coarse)
        for left, top, width, height, area in boxes[1:].tolist():
            suits = np.multiply(SCALES, math.sqrt(area)) < LARGEST_PX
            if suits.any() and not suits.all():
                rows = slice(max(top - AROUND_PX, 0), top + height + AROUND_PX)
                columns = slice(max(left - AROUND_PX, 0), left + width + AROUND_PX)
                mean[rows, columns] = probability[suits, rows, columns].mean(0)
        return logit(mean)


def small(picture: UInt8[ndarray, "height width *channel"]) -> UInt8[ndarray, "row column *channel"]:
    """Reduce a picture to `SHORTER_PX` on the shorter side; smaller ones stay as they are."""
    scale = min(1.0, SHORTER_PX / min(picture.shape[:2]))
    size = round(picture.shape[1] * scale), round(picture.shape[0] * scale)
    return cv2.resize(picture, size, interpolation=cv2.INTER_AREA)


def save(network: Appearance, folder: Path) -> None:
    """Write the trained weights, before batch norms are folded."""
    save_file({name: value.contiguous() for name, value in network.state_dict().items()}, folder / FILE)


def load(folder: Path) -> Appearance:
    """Read what `save` wrote, ready for recognition."""
    network = Recognizer()
    network.load_state_dict(load_file(folder / FILE))
    return fold_batch_norms(network.eval())
