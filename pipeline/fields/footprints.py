"""Image-space footprints of 3D Gaussians, shared by all rasterizers."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

BLUR_PX2 = 0.3
"""added to the variance of every footprint, so that none falls between pixels"""
NEAREST_M = 0.1
"""Gaussians nearer than this to the camera are not drawn"""
ALPHA_MIN, ALPHA_MAX = 1 / 255, 0.99
"""opacities below the first are not drawn, those above the second are held there (Kerbl et al. 2023)"""
CUTOFF = 3.33
"""standard deviations at which footprints are cut off: there an opacity of 0.99 has fallen to 1/255"""


@dataclass(frozen=True)
class Footprints:
    """Gaussians projected into one camera."""

    pixel: Float[Tensor, "point 2"]
    conic: Float[Tensor, "point 3"]
    """inverse covariance (a, b, c) of a x^2 + 2 b x y + c y^2, 1/pixel^2"""
    radius_px: Float[Tensor, "point"]
    depth: Float[Tensor, "point"]
