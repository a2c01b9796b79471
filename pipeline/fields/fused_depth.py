"""Measured depth of a scene, fused into sparse blocks of voxels: signed distance and color.

`FusedGeometry` is the fixed geometry of the scene's field. A table maps each video and place to a block of
8 x 8 x 8 cells, or to none (free or unseen). Videos share blocks except where one saw something else (moved
things); the last row is the shared scene. Blocks include the nodes on all their faces, so that interpolation
never leaves a block.
"""

import torch
from jaxtyping import Bool, Float, Float16, Int, Int32
from torch import Tensor, nn

CELLS = 8
"""cells along the edge of a block"""
NODES = CELLS + 1
CHANNELS = 5
"""signed distance / truncation, red, green, blue in 0..1 times the next, 1 where a color is known"""
EMPTY_BLOCK = 0
"""index of the block for free and unseen space"""


class FusedGeometry(nn.Module):
    """Signed distances and colors on sparse blocks, per video."""

    low: Float[Tensor, "3"]
    sizes: Float[Tensor, "2"]
    table: Int32[Tensor, "row x y z"]
    blocks: Float16[Tensor, "block 9 9 9 5"]
    corners: Int[Tensor, "8 3"]

    def __init__(
        self,
        low_m: Float[Tensor, "3"],
        voxel_m: float,
        truncation_m: float,
        table: Int32[Tensor, "row x y z"],
        blocks: Float16[Tensor, "block 9 9 9 5"],
    ):
        """Rows of ``table`` are the videos and, last, the shared scene; block 0 is empty."""
        super().__init__()
        self.register_buffer("low", low_m.float())
        self.register_buffer("sizes", torch.tensor([voxel_m, truncation_m]))
        self.register_buffer("table", table)
        self.register_buffer("blocks", blocks)
        corners = torch.stack(torch.meshgrid(*[torch.arange(2)] * 3, indexing="ij"), dim=-1).view(8, 3)
        self.register_buffer("corners", corners, persistent=False)

    @property
    def voxel_m(self) -> float:
        """Edge of a cell in meters."""
        return float(self.sizes[0])

    @property
    def truncation_m(self) -> float:
        """Signed distances saturate here, meters."""
        return float(self.sizes[1])

    def is_own(self, points: Float[Tensor, "point 3"], video: int) -> Bool[Tensor, "point"]:
        """Return where a video has a block of its own because it differs from the shared scene."""
        cell = ((points - self.low) / self.sizes[0]).floor().long()
        return self._block(cell, torch.full_like(cell[:, 0], video)) != self._block(
            cell, torch.full_like(cell[:, 0], -1)
        )

    def own_blocks(self, video: int) -> tuple[Float[Tensor, "block 3"], Float[Tensor, "block 9 9 9"]]:
        """Return the lowest corners of a video's own blocks and their nodes' signed distance / truncation."""
        place = torch.nonzero(self.table[video] != self.table[-1])
        block = self.table[video][tuple(place.T)].long()
        return self.low + place * (CELLS * self.sizes[0]), self.blocks[block][..., 0].float()

    def forward(
        self, points: Float[Tensor, "point 3"], video: Int[Tensor, "point"]
    ) -> Float[Tensor, "point 5"]:
        """Interpolate at world points, meters, in a video's scene (-1: the shared scene).

        Returns signed distance in units of the truncation, color in 0..1 (gray where unknown), and its
        confidence.
        """
        result = points.new_tensor([1.0, 0.5, 0.5, 0.5, 0.0]).repeat(len(points), 1)
        place = (points - self.low) / self.sizes[0]
        cell = place.detach().floor().long()
        block = self._block(cell, video)
        hit = torch.nonzero(block != EMPTY_BLOCK)[:, 0]
        if not len(hit):
            return result
        return result.index_put((hit,), self._trilinear(block[hit], cell[hit] % CELLS, (place - cell)[hit]))

    def _trilinear(
        self, block: Int[Tensor, "point"], within: Int[Tensor, "point 3"], offset: Float[Tensor, "point 3"]
    ) -> Float[Tensor, "point 5"]:
        """Interpolate in blocks: ``within`` counts cells from the block's corner, ``offset`` is the rest."""
        strides = torch.tensor([NODES * NODES, NODES, 1], device=within.device)
        nodes = ((within[:, None] + self.corners) * strides).sum(-1)  # CUDA multiplies no integer matrices
        values = self.blocks.view(-1, CHANNELS)[(block * NODES**3)[:, None] + nodes].float()
        share = torch.where(self.corners.bool(), offset[:, None], 1 - offset[:, None]).prod(-1)
        mixed = (share[..., None] * values).sum(1)
        known = mixed[:, 4:]
        color = torch.where(known > 0, mixed[:, 1:4] / known.clamp_min(1e-6), 0.5)
        return torch.cat([mixed[:, :1], color, known], dim=-1)

    def _block(self, cell: Int[Tensor, "point 3"], video: Int[Tensor, "point"]) -> Int[Tensor, "point"]:
        """Look up which block holds each cell; outside the table there is none."""
        size = torch.tensor(self.table.shape[1:], device=cell.device)
        block = cell.div(CELLS, rounding_mode="floor")
        inside = ((block >= 0) & (block < size)).all(-1)
        row = torch.where(video < 0, len(self.table) - 1, video)
        x, y, z = torch.minimum(block.clamp_min(0), size - 1).unbind(-1)
        return torch.where(inside, self.table[row, x, y, z].long(), EMPTY_BLOCK)
