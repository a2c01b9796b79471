"""The motion of one animal on the body of another of the same plan, quadruped to quadruped.

Bones are learned per animal and mean nothing to each other, so surfaces carry the motion: `corresponding`
finds for places of one body those of the other by the extents of both, `transferred` moves them as the other
body moves, and `fitted_bones` finds the bone poses whose linear blend comes nearest to that. `carried_root`
takes the root along. Shapes are canonical (agent frame, +z towards the head), metres.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from pipeline.geometry import rigid, subsampling

NEIGHBOURS = 4
"""Surface points that a corresponding place takes its weights from."""
EXTENT_PERCENT = (1.0, 99.0)
"""Between these percentiles of its vertices a body extends, along each axis."""
SURFACE_POINTS = 600
"""Vertices of the target that bones are fitted to, evenly chosen."""
SWEEPS = 6
"""Passes over all bones; a body retargeted to itself is then within a millimetre."""
FRAMES_AT_ONCE = 256
PRIOR = 1e-3
"""Weight of the transferred rotation against the fitted points: it decides where points lie on a line."""


@dataclass(frozen=True)
class SkinnedShape:
    """A surface at rest and what moves it."""

    vertices: Float[np.ndarray, "vertex 3"]
    weights: Float[np.ndarray, "vertex bone"]
    """of a linear blend"""
    agent_from_bone_rest: Float[np.ndarray, "bone 4 4"]

    @property
    def extent(self) -> Float[np.ndarray, "2 3"]:
        """Return the lower and the upper end along each axis."""
        return np.percentile(self.vertices, EXTENT_PERCENT, axis=0)


@dataclass(frozen=True)
class Retargeted:
    """A motion on the target's body."""

    world_from_agent: Float[np.ndarray, "frame 4 4"]
    agent_from_bone: Float[np.ndarray, "frame bone 4 4"]
    residual_m: Float[np.ndarray, "frame vertex"]
    """distance of fitted from transferred surface points"""


def retarget(
    source: SkinnedShape,
    target: SkinnedShape,
    world_from_agent: Float[np.ndarray, "frame 4 4"],
    agent_from_bone: Float[np.ndarray, "frame source_bone 4 4"],
) -> Retargeted:
    """Return the motion of ``source`` on the body ``target``."""
    chosen = subsampling.evenly(len(target.vertices), SURFACE_POINTS)
    part = SkinnedShape(
        target.vertices[chosen].astype(float), target.weights[chosen], target.agent_from_bone_rest
    )
    place, weights = corresponding(source, target, part.vertices)
    bones, residual = [], []
    for start in range(0, len(agent_from_bone), FRAMES_AT_ONCE):
        motion = agent_from_bone[start : start + FRAMES_AT_ONCE] @ rigid.inverse(source.agent_from_bone_rest)
        moved, turned = transferred(motion, weights, place)
        fitted, away = fitted_bones(part, _scaled(source, target, moved), turned)
        bones.append(fitted @ target.agent_from_bone_rest)
        residual.append(away)
    root = carried_root(source, target, world_from_agent)
    return Retargeted(root, np.concatenate(bones), np.concatenate(residual))


def corresponding(
    source: SkinnedShape, target: SkinnedShape, points: Float[np.ndarray, "point 3"]
) -> tuple[Float[np.ndarray, "point 3"], Float[np.ndarray, "point source_bone"]]:
    """Return where points of the target lie in the source once its extents are those of the target, and the
    skinning weights of the source there."""
    place = _scaled(target, source, points)
    distance, nearest = KDTree(source.vertices).query(place, k=NEIGHBOURS)
    share = 1 / np.maximum(distance, 1e-6)
    share /= share.sum(1, keepdims=True)
    return place, np.einsum("pk,pkb->pb", share, source.weights[nearest])


def shape_distance_m(source: SkinnedShape, target: SkinnedShape) -> float:
    """Return the mean distance of the target's vertices from the source's once its extents are the target's:
    how far the plans of both bodies differ, metres."""
    scaled = _scaled(source, target, source.vertices.astype(float))
    return float(KDTree(scaled).query(target.vertices)[0].mean())


def transferred(
    motion: Float[np.ndarray, "frame bone 4 4"],
    weights: Float[np.ndarray, "point bone"],
    place: Float[np.ndarray, "point 3"],
) -> tuple[Float[np.ndarray, "frame point 3"], Float[np.ndarray, "frame point 3 3"]]:
    """Move places by the linear blend of bone motions (posed from rest); also return how each is turned."""
    blended = np.einsum("pb,fbij->fpij", weights, motion)
    return np.einsum("fpij,pj->fpi", blended[..., :3, :3], place) + blended[..., :3, 3], blended[..., :3, :3]


def fitted_bones(
    body: SkinnedShape,
    points: Float[np.ndarray, "frame vertex 3"],
    turned: Float[np.ndarray, "frame vertex 3 3"],
) -> tuple[Float[np.ndarray, "frame bone 4 4"], Float[np.ndarray, "frame vertex"]]:
    """Find bone motions (posed from rest) whose linear blend puts the vertices nearest to points, and what is
    left.

    One bone after another takes what the others leave (Le and Deng, Smooth Skinning Decomposition with Rigid
    Bones, 2012, Sec. 5.2); weights stay.
    """
    frames, bones = len(points), body.weights.shape[1]
    motion = np.tile(np.eye(4), (frames, bones, 1, 1))
    for sweep in range(SWEEPS + 1):
        for bone in range(bones):
            held = body.weights[:, bone] > 1e-3
            weight, rest = body.weights[held, bone], body.vertices[held]
            if not held.any():
                continue
            goal = points[:, held] * weight[:, None]
            if sweep:  # the first pass lets every bone follow its own points
                others = np.einsum("vb,fbij->fvij", body.weights[held], motion)
                others -= weight[:, None, None] * motion[:, None, bone]
                goal = points[:, held] - np.einsum("fvij,vj->fvi", others[..., :3, :3], rest)
                goal -= others[..., :3, 3]
            motion[:, bone] = _rigid(weight, rest, goal, turned[:, held])
    blended = np.einsum("vb,fbij->fvij", body.weights, motion)
    shown = np.einsum("fvij,vj->fvi", blended[..., :3, :3], body.vertices) + blended[..., :3, 3]
    return motion, np.linalg.norm(shown - points, axis=-1)


def _rigid(
    weight: Float[np.ndarray, "vertex"],
    rest: Float[np.ndarray, "vertex 3"],
    goal: Float[np.ndarray, "frame vertex 3"],
    turned: Float[np.ndarray, "frame vertex 3 3"],
) -> Float[np.ndarray, "frame 4 4"]:
    """Minimize the squares of ``goal - weight * (rotation rest + translation)``, frame by frame."""
    square = (weight**2).sum()
    middle = weight**2 @ rest / square
    centre = np.einsum("v,fvi->fi", weight, goal) / square
    around = rest - middle
    spread = (weight**2 * (around**2).sum(-1)).sum()
    covariance = np.einsum("v,fvi,vj->fij", weight, goal - weight[:, None] * centre[:, None], around)
    covariance += (PRIOR * spread + 1e-12) * np.einsum("v,fvij->fij", weight / weight.sum(), turned)
    left, _, right = np.linalg.svd(covariance)
    left[:, :, 2] *= np.linalg.det(left @ right)[:, None]
    rotation = left @ right
    return rigid.make(rotation, centre - np.einsum("fij,j->fi", rotation, middle))


def carried_root(
    source: SkinnedShape, target: SkinnedShape, world_from_agent: Float[np.ndarray, "frame 4 4"]
) -> Float[np.ndarray, "frame 4 4"]:
    """Return the root of the target: steps as much longer as its root is higher above its feet, from where
    the source begins, and as much higher above what carries it."""
    legs, own_legs = -source.extent[0, 1], -target.extent[0, 1]
    root = world_from_agent.copy()
    place, begin = root[:, :3, 3], root[0, :3, 3].copy()
    level = [0, 2]
    place[:, level] = begin[level] + (place[:, level] - begin[level]) * (own_legs / legs)
    place[:, 1] += own_legs - legs
    return root


def _scaled(
    source: SkinnedShape, target: SkinnedShape, points: Float[np.ndarray, "*batch 3"]
) -> Float[np.ndarray, "*batch 3"]:
    """Stretch points of the source to the extents of the target."""
    (low, high), (own_low, own_high) = source.extent, target.extent
    return own_low + (points - low) / (high - low) * (own_high - own_low)
