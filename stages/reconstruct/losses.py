"""Losses of the reconstruction, per element and unweighted (ATS, Eq. 6 and the terms after it).

Weights are in the stage's configuration; `weighted` averages and weights the losses.
"""

from collections.abc import Mapping

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn import functional

from pipeline.core import distributed

DISTANCE_DELTA, COLOR_DELTA, FLOW_DELTA, DEPTH_DELTA = 0.3, 0.2, 0.5, 1.0
"""thresholds of the Huber losses, in the units of each loss"""
FLOW_UNIT_PX, DEPTH_UNIT_M = 10.0, 0.1
"""units of flow and of rendered depth"""
MIN_PROBABILITY = 1e-3
"""keeps the logarithms of opacities finite"""


def distance(
    distance_m: Float[Tensor, "*point"], target_m: Float[Tensor, "*point"], unit_m: float
) -> Float[Tensor, "*point"]:
    """Compare signed distances in units of ``unit_m``, robustly."""
    return functional.huber_loss(
        distance_m / unit_m, target_m / unit_m, reduction="none", delta=DISTANCE_DELTA
    )


def truncated_distance(
    distance_m: Float[Tensor, "*point"], target_m: Float[Tensor, "*point"], limit_m: float
) -> Float[Tensor, "*point"]:
    """Compare signed distances truncated at ``limit_m`` with untruncated targets, as `distance` does."""
    return distance(distance_m, target_m.clamp(-limit_m, limit_m), limit_m)


def color(predicted: Float[Tensor, "*point 3"], target: Float[Tensor, "*point 3"]) -> Float[Tensor, "*point"]:
    """Compare colors in 0..1, robustly."""
    return functional.huber_loss(predicted, target, reduction="none", delta=COLOR_DELTA).mean(-1)


def feature(
    predicted: Float[Tensor, "*point channel"], target: Float[Tensor, "*point channel"]
) -> Float[Tensor, "*point"]:
    """Compare unit-length features: half the squared chord, the cosine distance for unit vectors."""
    return 0.5 * (predicted - target).square().sum(-1)


def silhouette(predicted: Float[Tensor, "*ray"], agent: Float[Tensor, "*ray"]) -> Float[Tensor, "*ray"]:
    """Compare the agent's rendered opacity with the mask (0 or 1)."""
    finite = predicted.clamp(MIN_PROBABILITY, 1 - MIN_PROBABILITY)
    return functional.binary_cross_entropy(finite, agent, reduction="none")


def flow(pixel_px: Float[Tensor, "*ray 2"], target_px: Float[Tensor, "*ray 2"]) -> Float[Tensor, "*ray"]:
    """Compare pixel positions in the later frame, in units of `FLOW_UNIT_PX`, robustly."""
    pixel, target = pixel_px / FLOW_UNIT_PX, target_px / FLOW_UNIT_PX
    return functional.huber_loss(pixel, target, reduction="none", delta=FLOW_DELTA).sum(-1)


def depth(depth_m: Float[Tensor, "*ray"], target_m: Float[Tensor, "*ray"]) -> Float[Tensor, "*ray"]:
    """Compare rendered and measured depth in units of `DEPTH_UNIT_M`, robustly."""
    depth, target = depth_m / DEPTH_UNIT_M, target_m / DEPTH_UNIT_M
    return functional.huber_loss(depth, target, reduction="none", delta=DEPTH_DELTA)


def eikonal(
    distance: Float[Tensor, "point"], shifted: Float[Tensor, "3 point"], step_m: float
) -> Float[Tensor, "point"]:
    """Penalize gradient norms other than 1, by finite differences (Gropp et al. 2020)."""
    return (((shifted - distance) / step_m).square().sum(0).clamp_min(1e-8).sqrt() - 1).square()


def weighted(
    terms: Mapping[str, tuple[float, Float[Tensor, "..."]]], shared: bool = False
) -> dict[str, Float[Tensor, ""]]:
    """Average each term over its elements and multiply by its weight; empty terms are 0.

    With ``shared``, average over the elements of all processes, whose gradients are averaged later.
    """
    counts = torch.tensor([float(values.numel()) for _, values in terms.values()])
    counts = distributed.total(counts).clamp_min(1) / distributed.size() if shared else counts.clamp_min(1)
    averaged = zip(terms.items(), counts.tolist(), strict=True)
    return {name: weight * (values.sum() / count) for (name, (weight, values)), count in averaged}
