"""The readable reference of the rasterizers, in torch, for few Gaussians."""

import torch
from jaxtyping import Float
from torch import Tensor

from pipeline.fields import rasterize
from pipeline.fields.footprints import ALPHA_MAX, ALPHA_MIN, CUTOFF, NEAREST_M, Footprints


def draw(means_world, rotation, log_scale, opacity, values, *camera) -> tuple[Tensor, Tensor]:
    """Draw as `rasterize.draw` does, every Gaussian over every pixel."""
    footprints = rasterize.project(means_world, rotation, log_scale, *camera)
    return blend_dense(footprints, opacity, values, *camera[2:])


def blend_dense(
    footprints: Footprints,
    opacity: Float[Tensor, "point"],
    values: Float[Tensor, "point channel"],
    height: int,
    width: int,
) -> tuple[Float[Tensor, "height width channel"], Float[Tensor, "height width"]]:
    """Blend every Gaussian over every pixel, near to far: return blended values and coverage."""
    order = footprints.depth.argsort(stable=True)
    order = order[footprints.depth[order] > NEAREST_M]
    down, right = (torch.arange(side, device=opacity.device) + 0.5 for side in (height, width))
    y, x = torch.meshgrid(down, right, indexing="ij")
    offset = torch.stack([x, y], dim=-1)[None] - footprints.pixel[order][:, None, None]
    dx, dy = offset.unbind(-1)
    a, b, c = (part[:, None, None] for part in footprints.conic[order].unbind(-1))
    power = 0.5 * (a * dx * dx + c * dy * dy) + b * dx * dy
    alpha = (opacity[order][:, None, None] * torch.exp(-power)).clamp_max(ALPHA_MAX)
    alpha = torch.where((alpha < ALPHA_MIN) | (power > 0.5 * CUTOFF**2), torch.zeros_like(alpha), alpha)
    transmittance = torch.cumprod(1 - alpha, dim=0)
    weight = alpha * torch.cat([torch.ones_like(transmittance[:1]), transmittance[:-1]])
    return torch.einsum("phw,pc->hwc", weight, values[order]), weight.sum(0)
