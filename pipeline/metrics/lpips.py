"""LPIPS v0.1 with AlexNet (Zhang et al. 2018, "The Unreasonable Effectiveness of Deep Features as a
Perceptual Metric").

The network is five convolutions; only their weights come from elsewhere, so that neither torchvision nor the
`lpips` package is needed: `alexnet.pth` as torchvision saves it (`alexnet-owt-7be5be79.pth`) and
`lpips_alex.pth`, the channel weights of the `lpips` package (`lpips/weights/v0.1/alex.pth`).
"""

from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional

from pipeline.core.errors import InputError

ALEXNET_FILE, CHANNELS_FILE = "alexnet.pth", "lpips_alex.pth"
CONVOLUTIONS = (
    (0, 64, 11, 4, 2), (3, 192, 5, 1, 2), (6, 384, 3, 1, 1), (8, 256, 3, 1, 1), (10, 256, 3, 1, 1)
)  # fmt: skip
"""Of AlexNet: index in torchvision's `features`, channels, kernel, stride, padding."""
POOLED_BEFORE = (3, 6)
"""Convolutions that a maximum over 3 pixels with a stride of 2 comes before."""
SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
"""ImageNet's mean and deviation, for colors in -1 .. 1."""
EPSILON = 1e-10
MAX_LETTERS = 200
"""Of what torch says of a damaged file."""
SMALLEST_PX = 63
"""Least height and width of pictures: below, AlexNet's last maps are empty."""


class Lpips(nn.Module):
    """The learned distance of pictures, pixel by pixel."""

    def __init__(self) -> None:
        super().__init__()
        inner = [3] + [channels for _, channels, *_ in CONVOLUTIONS[:-1]]
        layers = {
            str(index): nn.Conv2d(before, channels, kernel, stride, padding)
            for before, (index, channels, kernel, stride, padding) in zip(inner, CONVOLUTIONS, strict=True)
        }
        self.layers = nn.ModuleDict(layers)
        self.weights = nn.ParameterList(torch.ones(channels) for _, channels, *_ in CONVOLUTIONS)

    @classmethod
    def load(cls, folder: Path, device: str = "cpu") -> "Lpips":
        """Read both files. Raises `InputError` MOD-001 for a missing file, MOD-003 for another network's."""
        model = cls()
        features, channels = _read(folder / ALEXNET_FILE), _read(folder / CHANNELS_FILE)
        try:
            for index, *_ in CONVOLUTIONS:
                prefix = f"features.{index}."
                own = {name: features[prefix + name] for name in ("weight", "bias")}
                model.layers[str(index)].load_state_dict(own)
            for number, weight in enumerate(model.weights):
                weight.data.copy_(channels[f"lin{number}.model.1.weight"].reshape(weight.shape))
        except (KeyError, RuntimeError) as error:
            what = f"no weights of LPIPS with AlexNet ({str(error)[:MAX_LETTERS]})"
            raise InputError("MOD-003", what, str(folder), "download them again") from error
        return model.to(device).eval().requires_grad_(False)

    def features(
        self, color: Float[Tensor, "1 3 height width"]
    ) -> list[Float[Tensor, "1 channel row column"]]:
        """Return the activations after every convolution, of unit length at every place; colors 0 .. 1."""
        shift, scale = (torch.tensor(each, device=color.device)[:, None, None] for each in (SHIFT, SCALE))
        x, found = (2 * color - 1 - shift) / scale, []
        for index, *_ in CONVOLUTIONS:
            if index in POOLED_BEFORE:
                x = functional.max_pool2d(x, 3, 2)
            x = functional.relu(self.layers[str(index)](x))
            found.append(x / (x.norm(dim=1, keepdim=True) + EPSILON))
        return found

    def distance(
        self, ours: Float[np.ndarray, "height width 3"], true: Float[np.ndarray, "height width 3"]
    ) -> Float[np.ndarray, "height width"]:
        """Return the distance at every pixel, layers bilinearly enlarged and summed; colors 0 .. 1.

        Its mean over a picture is LPIPS up to the interpolation; pictures under 63 pixels are NaN.
        """
        if min(true.shape[:2]) < SMALLEST_PX:
            return np.full(true.shape[:2], np.nan)
        device = next(self.parameters()).device
        pair = (
            torch.as_tensor(image, dtype=torch.float32, device=device).permute(2, 0, 1)[None]
            for image in (ours, true)
        )
        total = torch.zeros((1, 1, *true.shape[:2]), device=device)
        for a, b, weight in zip(*(self.features(image) for image in pair), self.weights, strict=True):
            squared = ((a - b).square() * weight[:, None, None]).sum(1, keepdim=True)
            total += functional.interpolate(squared, size=true.shape[:2], mode="bilinear")
        return total[0, 0].cpu().numpy().astype(np.float64)


def _read(path: Path) -> dict[str, Tensor]:
    remedy = "pipeline/metrics/lpips.py says where both files come from; name their folder in the recipe"
    if not path.is_file():
        raise InputError("MOD-001", "the weights of LPIPS are not there", str(path), remedy)
    try:
        return torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # whatever a damaged file makes torch raise
        raise InputError("MOD-003", f"no weights ({str(error)[:MAX_LETTERS]})", str(path), remedy) from error
