"""Depth from one picture: Depth Anything V2 (Yang et al. 2024) or Depth Pro (Bochkovskii et al. 2024).

Both answer in proportion to inverse depth, or are turned into it; meters come from whoever knows some.
"""

from typing import Literal, assert_never

import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image

from pipeline.backends import checkpoints

Kind = Literal["depth_anything_v2", "depth_pro"]
CHECKPOINTS: dict[Kind, str] = {
    "depth_anything_v2": "depth-anything/Depth-Anything-V2-Metric-Indoor-Small-hf",
    "depth_pro": "apple/DepthPro-hf",
}
LONGER_PX = 518
"""Longer side that Depth Anything was trained at, pixels."""
SCALES_OF_DEPTH_PRO = 4
"""Depth Pro looks at a square of so many patches a side: 1536 pixels of patches of 384."""
NEAREST_M = 0.05
"""Nearest depth that a metric network is believed, meters."""


class MonocularDepth:
    """A loaded network that looks at pictures one at a time."""

    def __init__(self, kind: Kind, weights: str, device: str) -> None:
        """Load a checkpoint folder. Raises MOD-001, MOD-002 and MOD-003 as `checkpoints` does."""
        path = checkpoints.folder(weights, kind, CHECKPOINTS[kind])
        self._kind: Kind = kind
        self._device = device
        match kind:
            case "depth_anything_v2":
                self._model = checkpoints.model("DepthAnythingForDepthEstimation", path, device)
                self._metric = self._model.config.depth_estimation_type == "metric"
            case "depth_pro":
                self._model = checkpoints.model("DepthProForDepthEstimation", path, device)
                self._metric = False
            case _:
                assert_never(kind)
        self._preparation = checkpoints.Preparation.read(path, Image.Resampling.BICUBIC)

    @torch.inference_mode()
    def inverse_depth(self, color: UInt8[np.ndarray, "height width 3"]) -> Float[np.ndarray, "rows columns"]:
        """Return numbers that grow with inverse depth, one per pixel of the network's own size."""
        pixels = torch.from_numpy(self._preparation.pixels(color, self._size(color.shape[:2])))
        found = self._model(pixel_values=pixels.to(self._device)).predicted_depth[0].float().cpu().numpy()
        return 1 / np.maximum(found, NEAREST_M) if self._metric else found

    def _size(self, size: tuple[int, int]) -> tuple[int, int]:
        """Return the (height, width) that the network wants a picture at."""
        match self._kind:
            case "depth_anything_v2":
                patch = self._model.config.patch_size
                scale = LONGER_PX / max(size)
                return tuple(max(patch, round(side * scale / patch) * patch) for side in size)
            case "depth_pro":
                side = self._model.config.patch_size * SCALES_OF_DEPTH_PRO
                return side, side
            case _:
                assert_never(self._kind)
