"""Train the pose regressor, on a fixed set of views or on newly rendered ones.

Several processes (`pipeline.core.distributed`) share each batch."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from pipeline.core import distributed
from pipeline.core.training import fit
from pipeline.localization.networks import PoseRegressor, on_grid, pose_loss
from pipeline.localization.patches import Patches, PcaBasis, Target
from stages.train_localizer.config import NetworkConfig
from stages.train_localizer.described_views import DescribedViews

PATCH_DROPOUT = 0.15
"""Share of a view's patches dropped in each step, which simulates occluders."""
UNCERTAINTY_WEIGHT = 0.1
"""Weight of the negative log likelihood of the predicted error, relative to the error itself."""
WEIGHT_DECAY, CLIP_NORM = 1e-4, 5.0
"""AdamW's weight decay and the gradient clipping norm."""
WARM_UP_SHARE, MIN_RATE = 0.02, 0.01
"""Share of the steps for learning rate warm-up, and the final learning rate relative to the initial one."""

DrawPatches = Callable[[np.random.Generator], tuple[Patches, np.ndarray]]
"""Draws a new view: its patches and ``map_from_camera``."""


@dataclass
class PoseSamples:
    """Ring buffer of the regressor's views; with fresh views each step replaces the oldest ones."""

    grids: Float[Tensor, "view axis row column"]
    rotation: Float[Tensor, "view 3 3"]
    position: Float[Tensor, "view 3"]
    oldest: int = 0

    def replace(self, basis: PcaBasis, draw: DrawPatches, target: Target, rng: np.random.Generator) -> None:
        """Replace the oldest view by a new one."""
        patches, map_from_camera = draw(rng)
        drawn = _sample(basis.project(patches.descriptors), patches, map_from_camera, target)
        for ring, value in zip((self.grids, self.rotation, self.position), drawn, strict=True):
            ring[self.oldest] = torch.from_numpy(value).to(ring.device)
        self.oldest = (self.oldest + 1) % len(self.grids)


def _sample(descriptors, patches, map_from_camera, target) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return a view's grid, rotation and regressed map position: camera center or agent center."""
    rotation, position = map_from_camera[:3, :3], map_from_camera[:3, 3]
    if target == "agent":
        position = rotation @ np.median(patches.points_camera, axis=0) + position
    return on_grid(descriptors, patches.cell), rotation.astype(np.float32), position.astype(np.float32)


def train_regressor(
    described: DescribedViews,
    target: Target,
    config: NetworkConfig,
    seed: int,
    draw: DrawPatches | None = None,
    device: str = "cpu",
) -> PoseRegressor:
    """Train the paper's regressor (Eq. 5) on a device, on the described views or new ones from ``draw``."""
    torch.manual_seed(seed)
    net = PoseRegressor(described.descriptors.shape[1], config.pose_width).to(device)
    samples = _samples(described, target, device)
    net.middle.copy_(samples.position.mean(0))  # so that the raw outputs are of order one
    net.extent.copy_(samples.position.std(0).norm())
    optimizer = torch.optim.AdamW(net.parameters(), config.rate, weight_decay=WEIGHT_DECAY)

    def loss(step: int, generator: torch.Generator):
        if draw is not None:
            rng = np.random.default_rng((seed, step))
            for _ in range(config.fresh_views):
                samples.replace(described.basis, draw, target, rng)
        chosen = torch.randint(
            len(samples.grids), (distributed.share(config.batch_views),), generator=generator
        ).to(device)
        grids = samples.grids[chosen]
        visible = torch.rand(len(chosen), 1, *grids.shape[2:], generator=generator) > PATCH_DROPOUT
        rotation, position, log_error = net(grids * visible.to(device))
        error, likelihood = pose_loss(
            rotation, position, log_error, samples.rotation[chosen], samples.position[chosen]
        )
        return {"error": error.mean(), "uncertainty": UNCERTAINTY_WEIGHT * likelihood.mean()}

    def schedule(done: float) -> float:
        warm_up = min(1.0, done / WARM_UP_SHARE + WARM_UP_SHARE)
        return warm_up * (MIN_RATE + (1 - MIN_RATE) * (0.5 + 0.5 * np.cos(np.pi * done)))

    fit(
        modules={"net": net}, optimizer=optimizer, loss=loss, steps=config.steps, seed=seed,
        label="localizer", clip_norm=CLIP_NORM, schedule=schedule, shared=True,
    )  # fmt: skip
    return net.eval()


def _samples(described: DescribedViews, target: Target, device: str) -> PoseSamples:
    parts = np.split(described.descriptors, np.cumsum(described.counts)[:-1])
    poses = described.map_from_camera[described.view]
    views = zip(parts, described.patches, poses, strict=True)
    columns = zip(*(_sample(*view, target) for view in views), strict=True)
    grids, rotation, position = (torch.from_numpy(np.stack(column)).to(device) for column in columns)
    return PoseSamples(grids, rotation, position)
