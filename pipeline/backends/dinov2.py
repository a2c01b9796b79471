"""DINOv2 (Oquab et al. 2023) as dense descriptors: a patch per cell, so that cells need no interpolation."""

import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image

from pipeline.backends import checkpoints

CHECKPOINT = "facebook/dinov2-small"


class Dinov2:
    """A loaded network that describes pictures one at a time."""

    def __init__(self, weights: str, device: str) -> None:
        """Load a checkpoint folder. Raises MOD-001, MOD-002 and MOD-003 as `checkpoints` does."""
        path = checkpoints.folder(weights, "DINOv2", CHECKPOINT)
        self._model = checkpoints.model("Dinov2Model", path, device)
        self._preparation = checkpoints.Preparation.read(path, Image.Resampling.BICUBIC)
        self._device = device

    @torch.inference_mode()
    def describe(
        self, color: UInt8[np.ndarray, "height width 3"], stride_px: int
    ) -> Float[np.ndarray, "rows columns channel"]:
        """Describe a picture at the cell centers (stride * (j + 1/2), stride * (i + 1/2)); unit length."""
        rows, columns = color.shape[0] // stride_px, color.shape[1] // stride_px
        whole = color[: rows * stride_px, : columns * stride_px]
        patch = self._model.config.patch_size
        pixels = torch.from_numpy(self._preparation.pixels(whole, (rows * patch, columns * patch)))
        tokens = self._model(pixel_values=pixels.to(self._device)).last_hidden_state[0, 1:]
        tokens = torch.nn.functional.normalize(tokens.float(), dim=-1)
        return tokens.reshape(rows, columns, -1).cpu().numpy()
