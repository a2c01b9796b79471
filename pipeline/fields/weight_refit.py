"""Approximate dual-quaternion skinning by linear blend skinning with four bones per vertex.

`refit_weights` finds, per vertex, the best four bones and convex weights for linear blending over a set of
poses; `residual_m` measures the error.
"""

from dataclasses import dataclass
from itertools import combinations

import numpy as np
from jaxtyping import Float, Int

from pipeline.data.glb import Skin
from pipeline.fields.skinning import SkinnedShape
from pipeline.geometry import rigid, subsampling

FOUR = 4
"""Bones of a vertex that every player blends."""
_CANDIDATES = 8
"""Heaviest bones among which they are chosen."""
_DESCENT_STEPS = 150


@dataclass(frozen=True)
class Poses:
    """Some poses of bones and surface, agent frame, meters."""

    posed_from_rest: Float[np.ndarray, "frame bone 4 4"]
    """motion of each bone"""
    posed: Float[np.ndarray, "frame vertex 3"]
    """target surface"""

    @classmethod
    def of(cls, body: SkinnedShape, agent_from_bone: Float[np.ndarray, "frame bone 4 4"]) -> "Poses":
        """Pose a surface by dual-quaternion blending, as the reconstruction does."""
        posed = np.stack([body.posed(bones) for bones in agent_from_bone])
        return cls(agent_from_bone @ rigid.inverse(body.agent_from_bone_rest), posed)


def farthest_poses(
    agent_from_bone: Float[np.ndarray, "frame bone 4 4"], count: int
) -> Int[np.ndarray, " chosen"]:
    """Choose poses by farthest-point sampling, beginning with the one furthest from the mean."""
    flat = agent_from_bone[:, :, :3].reshape(len(agent_from_bone), -1)
    first = int(((flat - flat.mean(0)) ** 2).sum(1).argmax())
    return np.unique(subsampling.farthest_points(flat, count, first))


def refit_weights(body: SkinnedShape, poses: Poses) -> Skin:
    """Return the best four bones per vertex with convex weights, heaviest first, by least squares."""
    candidates = np.argsort(-body.weights, axis=1, kind="stable")[:, :_CANDIDATES]
    gram = _gram(body.vertices, candidates, poses)
    start = np.take_along_axis(body.weights, candidates, 1)
    descended = _descend_on_simplex(gram, start / start.sum(1, keepdims=True))
    chosen = np.argsort(-descended, axis=1, kind="stable")[:, :FOUR]
    best = np.zeros_like(descended)
    sub_gram = np.take_along_axis(np.take_along_axis(gram, chosen[:, :, None], 1), chosen[:, None, :], 2)
    np.put_along_axis(best, chosen, _best_on_simplex(sub_gram), 1)
    order = np.argsort(-best, axis=1, kind="stable")[:, :FOUR]
    heaviest, joints = np.take_along_axis(best, order, 1), np.take_along_axis(candidates, order, 1)
    padding = ((0, 0), (0, FOUR - order.shape[1]))  # bones without weight become bone 0, as glTF asks
    joints, heaviest = np.pad(np.where(heaviest > 0, joints, 0), padding), np.pad(heaviest, padding)
    heaviest = (heaviest / heaviest.sum(1, keepdims=True)).astype(np.float32)
    names = tuple(f"bone_{bone:02d}" for bone in range(body.weights.shape[1]))
    return Skin(joints.astype(np.uint8), heaviest, body.agent_from_bone_rest, names)


def residual_m(
    vertices: Float[np.ndarray, "vertex 3"], blend: Skin, poses: Poses
) -> Float[np.ndarray, "frame vertex"]:
    """Return the distance between the linear blend and the posed surface."""
    distance = np.empty(poses.posed.shape[:2])
    for frame, bones in enumerate(poses.posed_from_rest):
        moved = (
            np.einsum("vkij,vj->vki", bones[blend.joints][..., :3, :3], vertices)
            + bones[blend.joints][..., :3, 3]
        )
        distance[frame] = np.linalg.norm(
            np.einsum("vk,vki->vi", blend.weights, moved) - poses.posed[frame], axis=1
        )
    return distance


def _gram(
    vertices: np.ndarray, candidates: Int[np.ndarray, "vertex k"], poses: Poses
) -> Float[np.ndarray, "vertex k k"]:
    """Sum over frames the products of each bone's error: for convex w the squared error is w' G w."""
    gram = np.zeros((len(vertices), candidates.shape[1], candidates.shape[1]))
    for bones, target in zip(poses.posed_from_rest, poses.posed, strict=True):
        moved = np.einsum("bij,vj->vbi", bones[:, :3, :3], vertices) + bones[None, :, :3, 3]
        error = np.take_along_axis(moved, candidates[:, :, None], 1) - target[:, None]
        gram += error @ error.transpose(0, 2, 1)
    return gram / len(poses.posed)


def _descend_on_simplex(
    gram: Float[np.ndarray, "vertex k k"], weights: Float[np.ndarray, "vertex k"]
) -> Float[np.ndarray, "vertex k"]:
    """Minimize w' G w over convex weights by projected gradient descent."""
    rate = 1.0 / np.maximum(np.trace(gram, axis1=1, axis2=2), 1e-20)[:, None]
    for _ in range(_DESCENT_STEPS):
        weights = _project_to_simplex(weights - rate * np.einsum("vij,vj->vi", gram, weights))
    return weights


def _project_to_simplex(values: Float[np.ndarray, "vertex k"]) -> Float[np.ndarray, "vertex k"]:
    """Return the nearest convex weights (Duchi et al. 2008)."""
    ordered = -np.sort(-values, axis=1)
    excess = (np.cumsum(ordered, 1) - 1) / np.arange(1, values.shape[1] + 1)
    last = (ordered > excess).sum(1) - 1
    return np.maximum(values - np.take_along_axis(excess, last[:, None], 1), 0)


def _best_on_simplex(gram: Float[np.ndarray, "vertex k k"]) -> Float[np.ndarray, "vertex k"]:
    """Minimize w' G w over convex weights exactly, by enumerating all supports."""
    count = gram.shape[1]
    ridge = 1e-9 * (np.trace(gram, axis1=1, axis2=2)[:, None, None] + 1e-12) * np.eye(count)
    best, best_cost = np.zeros(gram.shape[:2]), np.full(len(gram), np.inf)
    for size in range(1, count + 1):
        for support in map(list, combinations(range(count), size)):
            solved = np.linalg.solve(
                (gram + ridge)[:, support][:, :, support], np.ones((len(gram), size, 1))
            )[..., 0]
            total = solved.sum(1, keepdims=True)
            trial = np.zeros_like(best)
            trial[:, support] = solved / np.where(total == 0, 1, total)
            cost = np.einsum("vi,vij,vj->v", trial, gram, trial)
            better = (trial >= 0).all(1) & (total[:, 0] > 0) & (cost < best_cost)
            best[better], best_cost[better] = trial[better], cost[better]
    return best
