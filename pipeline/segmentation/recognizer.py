"""The network that recognizes the turnaround's animal in sessions without depth: file and pictures."""

from pathlib import Path

import cv2
from jaxtyping import UInt8
from numpy import ndarray
from safetensors.torch import load_file, save_file

from pipeline.segmentation.appearance import Appearance, fold_batch_norms

FILE = "recognizer.safetensors"
SHORTER_PX = 240
"""Shorter side of the pictures that it sees, pixels."""


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
    network = Appearance()
    network.load_state_dict(load_file(folder / FILE))
    return fold_batch_norms(network.eval())
