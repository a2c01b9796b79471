"""Rigid alignment of point sets: closed form (`kabsch`), and robust to outliers (`ransac_rigid`)."""

import numpy as np
from jaxtyping import Bool, Float

from pipeline.geometry import rigid

SIDE_TOLERANCE = 2.5
"""tolerance of side lengths of corresponding triangles, in thresholds: each end may err by one"""


def kabsch(
    source: Float[np.ndarray, "*batch point 3"],
    target: Float[np.ndarray, "*batch point 3"],
    weights: Float[np.ndarray, "*batch point"] | None = None,
) -> Float[np.ndarray, "*batch 4 4"]:
    """Return ``target_from_source`` of least weighted squared distance, without scale (Kabsch 1976)."""
    source, target = np.asarray(source, float), np.asarray(target, float)
    share = np.ones(source.shape[:-1]) if weights is None else np.asarray(weights, float)
    share = share / share.sum(-1, keepdims=True)
    source_mean = np.einsum("...n,...ni->...i", share, source)
    target_mean = np.einsum("...n,...ni->...i", share, target)
    covariance = np.einsum(
        "...n,...ni,...nj->...ij",
        share,
        source - source_mean[..., None, :],
        target - target_mean[..., None, :],
    )
    u, _, vt = np.linalg.svd(covariance)
    sign = np.ones(covariance.shape[:-1])
    sign[..., 2] = np.sign(np.linalg.det(vt.swapaxes(-1, -2) @ u.swapaxes(-1, -2)))
    rotation = (vt.swapaxes(-1, -2) * sign[..., None, :]) @ u.swapaxes(-1, -2)
    return rigid.make(rotation, target_mean - np.einsum("...ij,...j->...i", rotation, source_mean))


def ransac_rigid(
    source: Float[np.ndarray, "point 3"],
    target: Float[np.ndarray, "point 3"],
    *,
    threshold_m: float,
    iterations: int,
    rng: np.random.Generator,
    weights: Float[np.ndarray, "point"] | None = None,
    min_side_m: float = 0.2,
) -> tuple[Float[np.ndarray, "4 4"], Bool[np.ndarray, "point"]]:
    """Return ``target_from_source`` and the inliers among correspondences with many outliers.

    Triplets are drawn by weight; those whose side lengths disagree or whose sides are shorter than
    ``min_side_m`` are dropped before the closed form. The best hypothesis minimizes the truncated distance
    and is refitted on its inliers. With fewer than 3 points the identity and no inliers are returned.
    """
    count = len(source)
    if count < 3:
        return np.eye(4), np.zeros(count, bool)
    probability = None if weights is None else np.asarray(weights, float) / np.sum(weights)
    triplets = rng.choice(count, (iterations, 3), p=probability)
    sides_source = np.linalg.norm(source[triplets] - source[np.roll(triplets, 1, axis=1)], axis=-1)
    sides_target = np.linalg.norm(target[triplets] - target[np.roll(triplets, 1, axis=1)], axis=-1)
    plausible = (np.abs(sides_source - sides_target).max(1) < SIDE_TOLERANCE * threshold_m) & (
        sides_source.min(1) > min_side_m
    )
    if plausible.sum() < 4:
        plausible = sides_source.min(1) > 0
    if not plausible.any():
        return np.eye(4), np.zeros(count, bool)
    hypotheses = kabsch(source[triplets[plausible]], target[triplets[plausible]])
    distance = np.linalg.norm(rigid.apply(hypotheses, source[None]) - target, axis=-1)
    best = np.minimum(distance, threshold_m).sum(1).argmin()
    target_from_source, inlier = hypotheses[best], distance[best] < threshold_m
    for _ in range(4):
        if inlier.sum() < 3:
            break
        target_from_source = kabsch(source[inlier], target[inlier])
        inlier = np.linalg.norm(rigid.apply(target_from_source, source) - target, axis=-1) < threshold_m
    return target_from_source, inlier


def rotation_between(
    source: Float[np.ndarray, "3"], target: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "3 3"]:
    """Return the smallest rotation that turns direction ``source`` into direction ``target``."""
    source, target = source / np.linalg.norm(source), target / np.linalg.norm(target)
    axis = np.cross(source, target)
    sine, cosine = np.linalg.norm(axis), float(source @ target)
    if sine < 1e-12:
        if cosine > 0:
            return np.eye(3)
        axis = np.cross(source, np.eye(3)[np.abs(source).argmin()])
        return rigid.rotation_from_vector(axis / np.linalg.norm(axis) * np.pi)
    return rigid.rotation_from_vector(axis / sine * np.arctan2(sine, cosine))
