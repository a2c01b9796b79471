"""The Gaussian rasteriser for CUDA: gsplat, an optional dependency."""

import torch
from torch import Tensor

from pipeline.core.errors import InputError


class Gsplat:
    """Draws with gsplat; the same convention as `pipeline.fields.rasterize.draw`."""

    def __init__(self):
        """Raises `InputError` DEP-001 when gsplat is not installed or there is no CUDA device."""
        try:
            import gsplat
        except ImportError as error:
            raise InputError(
                "DEP-001",
                what="gsplat is not installed",
                where="rasterizer gsplat",
                remedy='install the extra `cuda`, or set backend = "tiles"',
            ) from error
        if not torch.cuda.is_available():
            raise InputError(
                "DEP-001",
                what="gsplat needs a CUDA device",
                where="rasterizer gsplat",
                remedy='set backend = "tiles"',
            )
        self._rasterization = gsplat.rasterization

    def draw(
        self, means_world: Tensor, rotation: Tensor, log_scale: Tensor, opacity: Tensor, values: Tensor,
        camera_from_world: Tensor, intrinsics: Tensor, height: int, width: int,
    ) -> tuple[Tensor, Tensor]:  # fmt: skip
        """Draw one view; see `pipeline.fields.rasterize.draw`."""
        image, coverage, _ = self._rasterization(
            means_world, torch.nn.functional.normalize(rotation, dim=-1), log_scale.exp(), opacity, values,
            camera_from_world[None], intrinsics[None], width, height, near_plane=0.1, eps2d=0.3,
        )  # fmt: skip
        return image[0], coverage[0, ..., 0]
