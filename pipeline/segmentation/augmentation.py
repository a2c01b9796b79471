"""Augmentation of training crops: scale and light."""

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from jaxtyping import Float, Shaped, UInt8
from torch import Tensor

from pipeline.segmentation.appearance import normalized

SHRINKING_BLUR_PX = 0.4
"""standard deviation of the anti-aliasing blur of downscaled crops, crop pixels"""


@dataclass(frozen=True)
class LightVariation:
    """How much light varies."""

    exposure: float
    """standard deviation, log"""
    white_balance: float
    """standard deviation per channel, share"""
    contrast: float
    """standard deviation, share"""
    brightness: float
    """standard deviation, of -1..1"""
    noise: float
    """largest standard deviation of added noise, of -1..1"""


def scaled_crop(
    color: UInt8[np.ndarray, "height width 3"],
    labels: Shaped[np.ndarray, "height width"],
    place: tuple[float, float],
    scale: float,
    shift_px: Float[np.ndarray, "2"],
    side: int,
    outside: int,
    turn_deg: float = 0.0,
) -> tuple[UInt8[np.ndarray, "side side 3"], Shaped[np.ndarray, "side side"]]:
    """Return a scaled and turned square crop in which a pixel (row, column) is at ``shift_px`` (x, y).

    Beyond the picture labels are ``outside`` and colors continue.
    """
    axes = cv2.getRotationMatrix2D((0, 0), turn_deg, 1 / scale)[:, :2]
    source = np.column_stack([axes, np.array(place)[::-1] - axes @ shift_px])
    linear, nearest = (how | cv2.WARP_INVERSE_MAP for how in (cv2.INTER_LINEAR, cv2.INTER_NEAREST))
    if scale < 1:
        color = cv2.GaussianBlur(color, (0, 0), SHRINKING_BLUR_PX / scale)
    color = cv2.warpAffine(color, source, (side, side), flags=linear, borderMode=cv2.BORDER_REPLICATE)
    return color, cv2.warpAffine(labels, source, (side, side), flags=nearest, borderValue=(outside,))


def in_other_light(
    color: UInt8[np.ndarray, "height width 3"], light: LightVariation, rng: np.random.Generator
) -> Float[Tensor, "3 height width"]:
    """Return a picture as network input, -1..1, in random light and with random noise."""
    tint = np.exp(light.exposure * rng.normal()) * (1 + light.white_balance * rng.normal(size=(3, 1, 1)))
    shown = (normalized(color) + 1) * torch.from_numpy(tint).float() - 1
    shown = shown * (1 + light.contrast * rng.normal()) + light.brightness * rng.normal()
    grain = rng.uniform(0, light.noise) * rng.standard_normal(shown.shape, np.float32)
    return (shown + torch.from_numpy(grain)).clamp(-1, 1).float()
