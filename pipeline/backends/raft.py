"""RAFT (Teed and Deng 2020), the basic network: all-pairs correlation, looked up by a recurrent update.

Written anew; parameters carry the names of the official weights (`raft-things.pth` and its like), which
`load` reads.
"""

import math
from collections import OrderedDict
from pathlib import Path
from pickle import UnpicklingError

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, UInt8
from torch import Tensor, nn

from pipeline.backends.checkpoints import LONGEST_REASON
from pipeline.core.errors import InputError

HIDDEN = 128
ENCODER_CHANNELS, MOTION_CHANNELS = (64, 96, 128), (192, 64)
"""of the published network: its three layers; what is made of the correlation and of the flow"""
LEVELS, RADIUS = 4, 4
CELL_PX = 8
"""pixels per cell in which flow is searched"""
REMEDY = "download raft-things.pth (github.com/princeton-vl/RAFT) and name it as `weights` in the recipe"


class Raft(nn.Module):
    """Optical flow between two pictures."""

    def __init__(self) -> None:
        super().__init__()
        self.fnet = _Encoder(256, nn.InstanceNorm2d)
        self.cnet = _Encoder(2 * HIDDEN, nn.BatchNorm2d)
        self.update_block = _Update()

    def forward(
        self,
        first: Float[Tensor, "batch 3 height width"],
        second: Float[Tensor, "batch 3 height width"],
        iterations: int,
        start: Float[Tensor, "batch 2 rows columns"] | None = None,
    ) -> Float[Tensor, "batch 2 height width"]:
        """Return the flow in pixels; colors 0..255, sides divisible by 8, ``start`` a guess in cells."""
        first, second = (2 * (picture / 255) - 1 for picture in (first, second))
        here, there = self.fnet(torch.cat([first, second])).float().chunk(2)
        pyramid = correlation_pyramid(here, there)
        hidden, context = self.cnet(first).split(HIDDEN, dim=1)
        hidden, context = torch.tanh(hidden), torch.relu(context)
        cells = _cell_index(here.shape[-2], here.shape[-1], here.device)
        target = cells + (torch.zeros_like(here[:, :2]) if start is None else start)
        for _ in range(iterations):
            hidden, step = self.update_block(hidden, context, look_up(pyramid, target), target - cells)
            target = target + step
        return upsampled(target - cells, 0.25 * self.update_block.mask(hidden))


def load(path: Path, device: str = "cpu") -> Raft:
    """Load official weights, ready for inference. Raises MOD-001 (missing), MOD-003 (other weights)."""
    if not path.is_file():
        raise InputError("MOD-001", "the weights of RAFT are not there", str(path), REMEDY)
    try:
        stored = torch.load(path, map_location="cpu", weights_only=True)
        stored = {name.removeprefix("module."): value for name, value in stored.items()}
        network = Raft()
        # `norm3` is the second name of what `downsample.1` holds.
        network.load_state_dict({name: value for name, value in stored.items() if ".norm3." not in name})
    except (RuntimeError, AttributeError, EOFError, ValueError, UnpicklingError) as error:
        what = f"these are not weights of the basic RAFT ({str(error)[:LONGEST_REASON]})"
        raise InputError("MOD-003", what, str(path), REMEDY) from error
    return network.to(device).eval()


@torch.inference_mode()
def flow_between(
    network: Raft,
    first: UInt8[np.ndarray, "height width 3"],
    second: UInt8[np.ndarray, "height width 3"],
    iterations: int,
    guess: Float[np.ndarray, "height width 2"] | None = None,
) -> Float[np.ndarray, "height width 2"]:
    """Return the flow in pixels between RGB pictures of any size, padded by repeating their borders."""
    device = next(network.parameters()).device
    height, width = first.shape[:2]
    down, across = -height % CELL_PX, -width % CELL_PX
    padding = (across // 2, across - across // 2, down // 2, down - down // 2)

    def padded(image: np.ndarray) -> Tensor:
        pixels = torch.from_numpy(image.astype(np.float32)).permute(2, 0, 1)[None].to(device)
        return F.pad(pixels, padding, mode="replicate")

    start = None if guess is None else F.avg_pool2d(padded(guess), CELL_PX) / CELL_PX
    flow = network(padded(first), padded(second), iterations, start)[0].permute(1, 2, 0)
    return flow[padding[2] : padding[2] + height, padding[0] : padding[0] + width].cpu().numpy()


def correlation_pyramid(
    here: Float[Tensor, "batch channel rows columns"], there: Float[Tensor, "batch channel rows columns"]
) -> list[Float[Tensor, "cell 1 _ _"]]:
    """Correlate every cell with every other; each level averages two by two of the targets (RAFT, Eq. 1)."""
    batch, channels, rows, columns = here.shape
    all_pairs = here.flatten(2).transpose(1, 2) @ there.flatten(2) / math.sqrt(channels)
    pyramid = [all_pairs.reshape(batch * rows * columns, 1, rows, columns)]
    for _ in range(LEVELS - 1):
        pyramid.append(F.avg_pool2d(pyramid[-1], 2))
    return pyramid


def look_up(
    pyramid: list[Float[Tensor, "cell 1 _ _"]], target: Float[Tensor, "batch 2 rows columns"]
) -> Float[Tensor, "batch channel rows columns"]:
    """Read the correlations in a window around each cell's target, in cells, on every level (RAFT, Eq. 2)."""
    batch, _, rows, columns = target.shape
    reach = torch.linspace(-RADIUS, RADIUS, 2 * RADIUS + 1, device=target.device)
    # x steps along the first axis: so were weights trained
    window = torch.stack(torch.meshgrid(reach, reach, indexing="ij"), dim=-1)
    centers, seen = target.permute(0, 2, 3, 1).reshape(-1, 1, 1, 2), []
    for level, correlation in enumerate(pyramid):
        index = centers / 2**level + window
        size = torch.tensor([max(side - 1, 1) for side in correlation.shape[:-3:-1]], device=target.device)
        read = F.grid_sample(correlation, 2 * index / size - 1, align_corners=True)
        seen.append(read.view(batch, rows, columns, -1))
    return torch.cat(seen, dim=-1).permute(0, 3, 1, 2).contiguous()


def upsampled(
    flow: Float[Tensor, "batch 2 rows columns"], mask: Float[Tensor, "batch 576 rows columns"]
) -> Float[Tensor, "batch 2 height width"]:
    """Return pixel flow: each pixel a convex combination of the nine cells around it."""
    batch, _, rows, columns = flow.shape
    weight = mask.view(batch, 1, 9, CELL_PX, CELL_PX, rows, columns).softmax(dim=2)
    around = F.unfold(CELL_PX * flow, 3, padding=1).view(batch, 2, 9, 1, 1, rows, columns)
    pixels = (weight * around).sum(2).permute(0, 1, 4, 2, 5, 3)
    return pixels.reshape(batch, 2, CELL_PX * rows, CELL_PX * columns)


def _cell_index(rows: int, columns: int, device: torch.device) -> Float[Tensor, "1 2 rows columns"]:
    y, x = torch.meshgrid(
        torch.arange(rows, device=device), torch.arange(columns, device=device), indexing="ij"
    )
    return torch.stack([x, y])[None].float()


class _Residual(nn.Module):
    def __init__(self, before: int, after: int, norm: type[nn.Module], stride: int) -> None:
        super().__init__()
        self.conv1, self.norm1 = nn.Conv2d(before, after, 3, stride, 1), norm(after)
        self.conv2, self.norm2 = nn.Conv2d(after, after, 3, 1, 1), norm(after)
        self.downsample = (
            nn.Identity() if stride == 1 else nn.Sequential(nn.Conv2d(before, after, 1, stride), norm(after))
        )

    def forward(self, x: Tensor) -> Tensor:
        y = torch.relu(self.norm1(self.conv1(x)))
        return torch.relu(self.downsample(x) + torch.relu(self.norm2(self.conv2(y))))


class _Encoder(nn.Module):
    """A picture at an eighth of its size."""

    def __init__(self, channels: int, norm: type[nn.Module]) -> None:
        super().__init__()
        first, second, third = ENCODER_CHANNELS
        self.conv1, self.norm1 = nn.Conv2d(3, first, 7, 2, 3), norm(first)
        self.layer1 = nn.Sequential(_Residual(first, first, norm, 1), _Residual(first, first, norm, 1))
        self.layer2 = nn.Sequential(_Residual(first, second, norm, 2), _Residual(second, second, norm, 1))
        self.layer3 = nn.Sequential(_Residual(second, third, norm, 2), _Residual(third, third, norm, 1))
        self.conv2 = nn.Conv2d(third, channels, 1)

    def forward(self, picture: Tensor) -> Tensor:
        x = torch.relu(self.norm1(self.conv1(picture)))
        return self.conv2(self.layer3(self.layer2(self.layer1(x))))


class _Update(nn.Module):
    """One step: what is seen around the target and the state so far give a better target."""

    def __init__(self) -> None:
        super().__init__()
        self.encoder, self.gru = _Motion(), _Recurrence()
        wide, flow = nn.Conv2d(HIDDEN, 256, 3, 1, 1), nn.Conv2d(256, 2, 3, 1, 1)
        self.flow_head = nn.Sequential(OrderedDict(conv1=wide, relu=nn.ReLU(), conv2=flow))
        wide, mask = nn.Conv2d(HIDDEN, 256, 3, 1, 1), nn.Conv2d(256, 9 * CELL_PX**2, 1)
        self.mask = nn.Sequential(wide, nn.ReLU(), mask)

    def forward(self, hidden: Tensor, context: Tensor, seen: Tensor, flow: Tensor) -> tuple[Tensor, Tensor]:
        hidden = self.gru(hidden, torch.cat([context, self.encoder(flow, seen)], dim=1))
        return hidden, self.flow_head(hidden)


class _Motion(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        seen = LEVELS * (2 * RADIUS + 1) ** 2
        around, flow = MOTION_CHANNELS
        self.convc1, self.convc2 = nn.Conv2d(seen, 256, 1), nn.Conv2d(256, around, 3, 1, 1)
        self.convf1, self.convf2 = nn.Conv2d(2, 128, 7, 1, 3), nn.Conv2d(128, flow, 3, 1, 1)
        self.conv = nn.Conv2d(flow + around, HIDDEN - 2, 3, 1, 1)

    def forward(self, flow: Tensor, seen: Tensor) -> Tensor:
        seen = torch.relu(self.convc2(torch.relu(self.convc1(seen))))
        moved = torch.relu(self.convf2(torch.relu(self.convf1(flow))))
        return torch.cat([torch.relu(self.conv(torch.cat([seen, moved], dim=1))), flow], dim=1)


class _Recurrence(nn.Module):
    """A gated unit along rows, then one along columns."""

    def __init__(self) -> None:
        super().__init__()
        for way, (size, padding) in {"1": ((1, 5), (0, 2)), "2": ((5, 1), (2, 0))}.items():
            for gate in ("convz", "convr", "convq"):
                setattr(self, gate + way, nn.Conv2d(3 * HIDDEN, HIDDEN, size, padding=padding))

    def forward(self, hidden: Tensor, given: Tensor) -> Tensor:
        for way in "12":
            update, reset, candidate = (getattr(self, gate + way) for gate in ("convz", "convr", "convq"))
            both = torch.cat([hidden, given], dim=1)
            share = torch.sigmoid(update(both))
            new = torch.tanh(candidate(torch.cat([torch.sigmoid(reset(both)) * hidden, given], dim=1)))
            hidden = (1 - share) * hidden + share * new
        return hidden
