"""Retarget the motion of one animal to another with the same body plan, quadruped to quadruped.

Bones are learned per animal and do not correspond, so motion is transferred by surfaces:
`find_correspondences` aligns the extents of both bodies, `transfer` moves the corresponding points with the
source, and `fit_bones` finds the bone poses whose linear blend fits them best. `retarget_root`
scales the path. Shapes are canonical (agent frame, +z towards the head), meters.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from pipeline.fields.skinning import SkinnedShape
from pipeline.geometry import rigid, subsampling

NEIGHBORS = 4
"""Nearest source vertices from which skinning weights are interpolated."""
EXTENT_PERCENT = (1.0, 99.0)
"""Percentiles of the vertices that define a body's extent along each axis."""
SURFACE_POINTS = 600
"""Vertices of the target that bones are fitted to, evenly chosen."""
SWEEPS = 6
"""Passes over all bones; a body retargeted to itself is then within a millimeter."""
FRAMES_AT_ONCE = 256
ROTATION_PRIOR = 1e-3
"""Weight of the transferred rotation relative to the points: resolves fits of collinear points."""


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
    part = target.only(subsampling.evenly(len(target.vertices), SURFACE_POINTS))
    place, weights = find_correspondences(source, target, part.vertices)
    bones, residual = [], []
    for start in range(0, len(agent_from_bone), FRAMES_AT_ONCE):
        motion = agent_from_bone[start : start + FRAMES_AT_ONCE] @ rigid.inverse(source.agent_from_bone_rest)
        target_points, rotations = transfer(motion, weights, place)
        fitted, distance = fit_bones(part, _scaled(source, target, target_points), rotations)
        bones.append(fitted @ target.agent_from_bone_rest)
        residual.append(distance)
    root = retarget_root(source, target, world_from_agent)
    return Retargeted(root, np.concatenate(bones), np.concatenate(residual))


def find_correspondences(
    source: SkinnedShape, target: SkinnedShape, points: Float[np.ndarray, "point 3"]
) -> tuple[Float[np.ndarray, "point 3"], Float[np.ndarray, "point source_bone"]]:
    """Map points of the target into the source by aligning extents; also return the source's skinning weights
    there."""
    place = _scaled(target, source, points)
    distance, nearest = KDTree(source.vertices).query(place, k=NEIGHBORS)
    share = 1 / np.maximum(distance, 1e-6)
    share /= share.sum(1, keepdims=True)
    return place, np.einsum("pk,pkb->pb", share, source.weights[nearest])


def shape_distance_m(source: SkinnedShape, target: SkinnedShape) -> float:
    """Return how far the body plans differ: mean distance from the target's vertices to the source's after
    aligning extents, meters."""
    scaled = _scaled(source, target, source.vertices)
    return float(KDTree(scaled).query(target.vertices)[0].mean())


def transfer(
    motion: Float[np.ndarray, "frame bone 4 4"],
    weights: Float[np.ndarray, "point bone"],
    place: Float[np.ndarray, "point 3"],
) -> tuple[Float[np.ndarray, "frame point 3"], Float[np.ndarray, "frame point 3 3"]]:
    """Move points by linear blend skinning with motions (posed from rest); also return their rotations."""
    blended = np.einsum("pb,fbij->fpij", weights, motion)
    return np.einsum("fpij,pj->fpi", blended[..., :3, :3], place) + blended[..., :3, 3], blended[..., :3, :3]


def fit_bones(
    body: SkinnedShape,
    points: Float[np.ndarray, "frame vertex 3"],
    rotations: Float[np.ndarray, "frame vertex 3 3"],
) -> tuple[Float[np.ndarray, "frame bone 4 4"], Float[np.ndarray, "frame vertex"]]:
    """Fit bone motions (posed from rest) to posed vertices by least squares; also return residuals.

    Block coordinate descent over bones (Le and Deng, Smooth Skinning Decomposition with Rigid Bones, 2012,
    Sec. 5.2); weights are fixed.
    """
    frames, bones = len(points), body.weights.shape[1]
    motion = np.tile(np.eye(4), (frames, bones, 1, 1))
    for sweep in range(SWEEPS + 1):
        for bone in range(bones):
            influenced = body.weights[:, bone] > 1e-3
            weight, rest = body.weights[influenced, bone], body.vertices[influenced]
            if not influenced.any():
                continue
            goal = points[:, influenced] * weight[:, None]
            if sweep:  # the first pass lets every bone follow its own points
                others = np.einsum("vb,fbij->fvij", body.weights[influenced], motion)
                others -= weight[:, None, None] * motion[:, None, bone]
                goal = points[:, influenced] - np.einsum("fvij,vj->fvi", others[..., :3, :3], rest)
                goal -= others[..., :3, 3]
            motion[:, bone] = _fit_rigid(weight, rest, goal, rotations[:, influenced])
    blended = np.einsum("vb,fbij->fvij", body.weights, motion)
    posed = np.einsum("fvij,vj->fvi", blended[..., :3, :3], body.vertices) + blended[..., :3, 3]
    return motion, np.linalg.norm(posed - points, axis=-1)


def _fit_rigid(
    weight: Float[np.ndarray, "vertex"],
    rest: Float[np.ndarray, "vertex 3"],
    goal: Float[np.ndarray, "frame vertex 3"],
    rotations: Float[np.ndarray, "frame vertex 3 3"],
) -> Float[np.ndarray, "frame 4 4"]:
    """Minimize the squares of ``goal - weight * (rotation rest + translation)`` in each frame."""
    square = (weight**2).sum()
    rest_centroid = weight**2 @ rest / square
    centroid = np.einsum("v,fvi->fi", weight, goal) / square
    centered = rest - rest_centroid
    variance = (weight**2 * (centered**2).sum(-1)).sum()
    covariance = np.einsum("v,fvi,vj->fij", weight, goal - weight[:, None] * centroid[:, None], centered)
    covariance += (ROTATION_PRIOR * variance + 1e-12) * np.einsum(
        "v,fvij->fij", weight / weight.sum(), rotations
    )
    rotation = rigid.nearest_rotation(covariance)
    return rigid.make(rotation, centroid - np.einsum("fij,j->fi", rotation, rest_centroid))


def retarget_root(
    source: SkinnedShape, target: SkinnedShape, world_from_agent: Float[np.ndarray, "frame 4 4"]
) -> Float[np.ndarray, "frame 4 4"]:
    """Scale the root's horizontal path by the ratio of root heights above the feet, from the same start, and
    raise it by their difference."""
    source_height, target_height = -extent(source)[0, 1], -extent(target)[0, 1]
    root = world_from_agent.copy()
    place, begin = root[:, :3, 3], root[0, :3, 3].copy()
    level = [0, 2]
    place[:, level] = begin[level] + (place[:, level] - begin[level]) * (target_height / source_height)
    place[:, 1] += target_height - source_height
    return root


def extent(shape: SkinnedShape) -> Float[np.ndarray, "2 3"]:
    """Return the lower and the upper end of a body along each axis."""
    return np.percentile(shape.vertices, EXTENT_PERCENT, axis=0)


def _scaled(
    source: SkinnedShape, target: SkinnedShape, points: Float[np.ndarray, "*batch 3"]
) -> Float[np.ndarray, "*batch 3"]:
    """Stretch points of the source to the extents of the target."""
    (low, high), (own_low, own_high) = extent(source), extent(target)
    return own_low + (points - low) / (high - low) * (own_high - own_low)
