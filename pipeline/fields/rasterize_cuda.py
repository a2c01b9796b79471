"""The Gaussian rasterizer for CUDA: gsplat 1.5.3, an optional dependency."""

import importlib

import torch
from jaxtyping import Float
from torch import Tensor

from pipeline.core.errors import InputError
from pipeline.fields.footprints import BLUR_PX2, NEAREST_M


def draw(
    means_world: Float[Tensor, "point 3"], rotation: Float[Tensor, "point 4"],
    log_scale: Float[Tensor, "point 3"],
    opacity: Float[Tensor, "point"], values: Float[Tensor, "point channel"],
    camera_from_world: Float[Tensor, "4 4"], intrinsics: Float[Tensor, "3 3"], height: int, width: int,
) -> tuple[Float[Tensor, "height width channel"], Float[Tensor, "height width"]]:  # fmt: skip
    """Draw one view, meters, as `pipeline.fields.rasterize.draw` does.

    Raises `InputError` DEP-001 when gsplat is not installed or compiled, or there is no CUDA device.
    """
    where, tiles = "rasterizer gsplat", 'set backend = "tiles"'
    try:
        gsplat = importlib.import_module("gsplat")
    except ImportError as error:
        remedy = f"pip install gsplat==1.5.3, or {tiles}"
        raise InputError("DEP-001", "gsplat is not installed", where, remedy) from error
    if not torch.cuda.is_available():
        raise InputError("DEP-001", "gsplat needs a CUDA device", where, tiles)
    if importlib.import_module("gsplat.cuda._backend")._C is None:
        raise InputError("DEP-001", "gsplat found no compiler (nvcc) for its kernels", where, tiles)
    image, coverage, _ = gsplat.rasterization(
        means_world, torch.nn.functional.normalize(rotation, dim=-1), log_scale.exp(), opacity, values,
        camera_from_world[None], intrinsics[None], width, height, near_plane=NEAREST_M, eps2d=BLUR_PX2,
    )  # fmt: skip
    return image[0], coverage[0, ..., 0]
