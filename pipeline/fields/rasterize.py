"""Draw 3D Gaussians (Kerbl et al. 2023): project them into a camera, then blend them front to back.

`draw` uses the tile rasterizer for a CPU or gsplat 1.5.3, an optional dependency, on CUDA; the tests compare
both with a readable one in torch, values and gradients.
"""

import importlib
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from pipeline.core.errors import InputError
from pipeline.fields.footprints import BLUR_PX2, CUTOFF, NEAREST_M, Footprints
from pipeline.geometry import rigid_torch

Backend = Literal["tiles", "gsplat"]
VIEW_MARGIN = 0.15
"""footprints are linearized at most this share of the picture outside its edges, as in 3DGS"""


def project(
    means_world: Float[Tensor, "point 3"], rotation: Float[Tensor, "point 4"],
    log_scale: Float[Tensor, "point 3"],
    camera_from_world: Float[Tensor, "4 4"], intrinsics: Float[Tensor, "3 3"], height: int, width: int,
) -> Footprints:  # fmt: skip
    """Project Gaussians by the local affine approximation of the camera (Zwicker et al. 2002).

    The linearization point is clamped to 15 % outside the picture; farther out it would diverge.

    Args:
        rotation: quaternions wxyz, world from the Gaussian's own axes.
        log_scale: logarithm of the standard deviations in meters.
    """
    view = camera_from_world[:3, :3]
    x, y, depth = (means_world @ view.T + camera_from_world[:3, 3]).unbind(-1)
    z = depth.clamp_min(NEAREST_M)
    fx, fy, cx, cy = intrinsics[0, 0], intrinsics[1, 1], intrinsics[0, 2], intrinsics[1, 2]
    zero = torch.zeros_like(z)
    right = (x / z).clamp(-(VIEW_MARGIN * width + cx) / fx, ((1 + VIEW_MARGIN) * width - cx) / fx)
    down = (y / z).clamp(-(VIEW_MARGIN * height + cy) / fy, ((1 + VIEW_MARGIN) * height - cy) / fy)
    affine = torch.stack(
        [torch.stack([fx / z, zero, -fx * right / z], -1), torch.stack([zero, fy / z, -fy * down / z], -1)],
        dim=1,
    )
    factor = affine @ view @ (rigid_torch.rotation_from_quaternion(rotation) * log_scale.exp()[:, None])
    covariance = factor @ factor.transpose(1, 2)
    a, b, c = covariance[:, 0, 0] + BLUR_PX2, covariance[:, 0, 1], covariance[:, 1, 1] + BLUR_PX2
    determinant = (a * c - b * b).clamp_min(1e-6)
    radius = CUTOFF * (0.5 * (a + c) + (0.25 * (a - c) ** 2 + b * b).clamp_min(1e-9).sqrt()).detach().sqrt()
    return Footprints(
        torch.stack([fx * x / z + cx, fy * y / z + cy], -1),
        torch.stack([c, -b, a], -1) / determinant[:, None],
        radius,
        depth,
    )


@torch.no_grad()
def in_view(
    means_world: Float[Tensor, "point 3"], log_scale: Float[Tensor, "point 3"],
    camera_from_world: Float[Tensor, "4 4"], intrinsics: Float[Tensor, "3 3"], height: int, width: int,
) -> Int[Tensor, "chosen"]:  # fmt: skip
    """Return which Gaussians may overlap the picture, by their bounding spheres."""
    camera = means_world @ camera_from_world[:3, :3].T + camera_from_world[:3, 3]
    z = camera[:, 2].clamp_min(NEAREST_M)
    reach = CUTOFF * log_scale.amax(-1).exp() / z * intrinsics[0, 0] + 2
    x, y = (intrinsics[axis, axis] * camera[:, axis] / z + intrinsics[axis, 2] for axis in (0, 1))
    inside = (x > -reach) & (x < width + reach) & (y > -reach) & (y < height + reach)
    return torch.nonzero(inside & (camera[:, 2] > NEAREST_M))[:, 0]


def draw(
    means_world: Float[Tensor, "point 3"], rotation: Float[Tensor, "point 4"],
    log_scale: Float[Tensor, "point 3"],
    opacity: Float[Tensor, "point"], values: Float[Tensor, "point channel"],
    camera_from_world: Float[Tensor, "4 4"], intrinsics: Float[Tensor, "3 3"],
    height: int, width: int, backend: Backend = "tiles",
) -> tuple[Float[Tensor, "height width channel"], Float[Tensor, "height width"]]:  # fmt: skip
    """Draw Gaussians with any values (color, depth, masks ...): returns blended values and coverage 0..1.

    Raises `InputError` DEP-001 when gsplat is not installed or compiled, or there is no CUDA device for it.
    """
    if backend == "tiles":
        from pipeline.fields.rasterize_tiles import blend_tiles  # numba compiles on import

        camera = camera_from_world, intrinsics, height, width
        footprints = project(means_world, rotation, log_scale, *camera)
        return blend_tiles(footprints, opacity, values, height, width)
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
