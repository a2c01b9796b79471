"""The network that recognizes the turnaround's animal in sessions without depth: file and pictures."""

from pathlib import Path

import cv2
from jaxtyping import Float, UInt8
from numpy import ndarray
from safetensors.torch import load_file, save_file
from scipy.special import expit, logit

from pipeline.segmentation.appearance import Appearance, fold_batch_norms

FILE = "recognizer.safetensors"
SHORTER_PX = 240
"""Shorter side of the pictures that it sees at scale 1, pixels."""
SCALES = (1.0, 2.0, 3.0)
"""Scales at which it recognizes: the coarsest has most context, and a session's animal is small."""


class Recognizer(Appearance):
    """A network that recognizes an animal by its mean probability over several scales of a picture."""

    def log_odds(self, color: UInt8[ndarray, "height width channel"]) -> Float[ndarray, "height width"]:
        """Return the log-odds of every pixel of a picture from `small`, within +-8."""
        size, found = color.shape[1::-1], []
        for scale in SCALES:
            scaled = cv2.resize(color, None, fx=scale, fy=scale, interpolation=cv2.INTER_CUBIC)
            found.append(cv2.resize(super().log_odds(scaled), size, interpolation=cv2.INTER_AREA))
        return logit(expit(found).mean(0))


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
