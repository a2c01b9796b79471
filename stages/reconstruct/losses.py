"""The losses of the reconstruction: pure, per element, unweighted (paper 001, Eq. 6 and the terms after it).

Weights stand in the stage's configuration; `weighted` is the one place where losses are averaged and summed.
"""

from collections.abc import Mapping

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from pipeline import together


def truncated_distance(found_m: Float[Tensor, "*point"], target_m: Float[Tensor, "*point"], limit_m: float) -> Float[Tensor, "*point"]:
    """Compare signed distances, both cut at ``limit_m`` and in units of it, robustly."""
    target = target_m.clamp(-limit_m, limit_m)
    return functional.huber_loss(found_m / limit_m, target / limit_m, reduction="none", delta=0.3)


def color(found: Float[Tensor, "*point 3"], target: Float[Tensor, "*point 3"]) -> Float[Tensor, "*point"]:
    """Compare colours in 0..1, robustly."""
    return functional.huber_loss(found, target, reduction="none", delta=0.2).mean(-1)


def feature(found: Float[Tensor, "*point channel"], target: Float[Tensor, "*point channel"]) -> Float[Tensor, "*point"]:
    """Compare unit-length features: half the squared chord, the cosine distance for unit vectors."""
    return 0.5 * (found - target).square().sum(-1)


def silhouette(found: Float[Tensor, "*ray"], agent: Float[Tensor, "*ray"]) -> Float[Tensor, "*ray"]:
    """Compare the agent's rendered opacity with the mask (0 or 1)."""
    return functional.binary_cross_entropy(found.clamp(1e-3, 1 - 1e-3), agent, reduction="none")


def flow(found_px: Float[Tensor, "*ray 2"], target_px: Float[Tensor, "*ray 2"], scale_px: float = 10.0) -> Float[Tensor, "*ray"]:
    """Compare where points are seen later, in units of ``scale_px``, robustly."""
    return functional.huber_loss(found_px / scale_px, target_px / scale_px, reduction="none", delta=0.5).sum(-1)


def depth(found_m: Float[Tensor, "*ray"], target_m: Float[Tensor, "*ray"], scale_m: float = 0.1) -> Float[Tensor, "*ray"]:
    """Compare rendered and measured depth in units of ``scale_m``, robustly."""
    return functional.huber_loss(found_m / scale_m, target_m / scale_m, reduction="none", delta=1.0)


def eikonal(distance: Float[Tensor, "point"], beside: Float[Tensor, "3 point"], step_m: float) -> Float[Tensor, "point"]:
    """Ask for a gradient of length 1, by differences along the three axes."""
    return (((beside - distance) / step_m).square().sum(0).clamp_min(1e-8).sqrt() - 1).square()


def weighted(terms: Mapping[str, tuple[float, Tensor]], shared: bool = False) -> dict[str, Tensor]:
    """Average each term over its elements and weigh it; terms without elements vanish.

    With ``shared``, the elements of all processes count (`pipeline.together`), whose gradients will be averaged.
    """
    counts = torch.tensor([float(values.numel()) for _, values in terms.values()])
    counts = (together.total(counts).clamp_min(1) / together.size() if shared else counts.clamp_min(1)).tolist()
    return {name: weight * (values.sum() / count) for (name, (weight, values)), count in zip(terms.items(), counts, strict=True)}
