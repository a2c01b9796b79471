"""The animals: smooth watertight skinned surfaces with 25 bones and patterned fur, of each species.

`grow` blends rounded cones along the bones into a signed distance, extracts one surface by marching cubes,
and gives each vertex up to four bones. Frame: `agent`, origin at the body's center, +y up, +z towards the
head, +x to its left, meters. At rest every bone's axes are the agent's; only its origin differs.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from numba import njit
from skimage.measure import marching_cubes

from pipeline.geometry.meshes import area_normals
from stages.synthesize_capture.anatomy import Anatomy, Bone, Flesh
from stages.synthesize_capture.cat import CAT
from stages.synthesize_capture.config import Species
from stages.synthesize_capture.dog import DOG
from stages.synthesize_capture.hen import HEN
from stages.synthesize_capture.rabbit import RABBIT

BODIES: dict[Species, Anatomy] = {"cat": CAT, "dog": DOG, "rabbit": RABBIT, "hen": HEN}
BONES, HEADS = CAT.bones, CAT.heads
INDEX = {bone.name: index for index, bone in enumerate(BONES)}
"""Index of a bone by name, the same in every species."""
SOFTNESS = [0.03] * 6 + [0.012] * 5 + [0.024, 0.012, 0.008, 0.03, 0.014, 0.008, 0.008] * 2
"""Width of each bone's smooth union with those before it, meters."""


@dataclass(frozen=True)
class Animal:
    """The skinned surface at rest, agent frame."""

    vertices: Float[np.ndarray, "vertex 3"]
    faces: Int[np.ndarray, "face 3"]
    bone: Int[np.ndarray, "vertex 4"]
    weight: Float[np.ndarray, "vertex 4"]
    fur: Float[np.ndarray, "vertex 4"]
    """Linear RGB albedo and strength of the fine pattern."""
    anatomy: Anatomy


def grow(rng: np.random.Generator, *, cell_m: float = 0.013, species: Species = "cat") -> Animal:
    """Make an animal; the random generator determines its coat."""
    return embody(BODIES[species], rng, cell_m)


def embody(anatomy: Anatomy, rng: np.random.Generator, cell_m: float) -> Animal:
    """Make the surface of a body; ``cell_m`` is the grid's spacing at the size of its bones."""
    axes = [np.arange(low, high, cell_m) for low, high in anatomy.box]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    distance = _body_distance(anatomy, points.reshape(-1, 3)).reshape(points.shape[:3])
    vertices, faces, _, _ = marching_cubes(distance, 0.0, spacing=(cell_m,) * 3)
    vertices = vertices + np.array([axis[0] for axis in axes])
    bone, weight = _skin(anatomy, vertices)
    shown = (anatomy.size * vertices).astype(np.float32)
    return Animal(shown, faces.astype(np.int32), bone, weight, anatomy.coat(vertices, rng), anatomy)


def _body_distance(anatomy: Anatomy, points: Float[np.ndarray, "point 3"]) -> Float[np.ndarray, "point"]:
    """Return the smooth union of the cones of all bones and flesh (polynomial smooth minimum)."""
    parts = [*zip(anatomy.bones, SOFTNESS, strict=True), *((part, part.softness) for part in anatomy.flesh)]
    total = _cone(points, anatomy.bones[0])
    for part, soft in parts[1:]:
        distance = _cone(points, part)
        mix = np.maximum(soft - np.abs(total - distance), 0) / soft
        total = np.minimum(total, distance) - mix * mix * soft / 4
    return total


def _cone(points: Float[np.ndarray, "point 3"], part: Bone | Flesh) -> Float[np.ndarray, "point"]:
    head, axis = np.array(part.head), np.subtract(part.tail, part.head)
    along = np.clip((points - head) @ axis / (axis @ axis), 0, 1)
    return np.linalg.norm(points - head - along[:, None] * axis, axis=-1) - (
        part.radius[0] + along * (part.radius[1] - part.radius[0])
    )


def _skin(
    anatomy: Anatomy, vertices: Float[np.ndarray, "vertex 3"]
) -> tuple[Int[np.ndarray, "vertex 4"], Float[np.ndarray, "vertex 4"]]:
    """Return skinning weights by a soft minimum of bone distances, without bones of the opposite limbs."""
    distance = np.stack([_cone(vertices, bone) for bone in anatomy.bones], axis=-1)
    score = np.exp(-np.maximum(distance - distance.min(1, keepdims=True), 0) / 0.009)
    for name, sign in (("left", 1), ("right", -1)):
        limb = [index for index, bone in enumerate(BONES) if bone.name.startswith(name)]
        score[:, limb] *= 1 / (1 + np.exp(-np.clip(sign * vertices[:, :1] / 0.006, -30, 30)))
    bone = np.argsort(-score, axis=1, kind="stable")[:, :4]
    weight = np.take_along_axis(score, bone, axis=1)
    weight[weight < 0.01 * weight[:, :1]] = 0
    return bone.astype(np.int32), (weight / weight.sum(1, keepdims=True)).astype(np.float32)


def surface(animal: Animal, a_from_bone: Float[np.ndarray, "bone 4 4"]) -> Float[np.ndarray, "vertex 3"]:
    """Apply linear blend skinning; return vertices in frame a (at rest, bones are at their heads)."""
    a_from_rest = a_from_bone.copy()
    a_from_rest[:, :3, 3] -= np.einsum(
        "bij,bj->bi", a_from_bone[:, :3, :3], animal.anatomy.size * animal.anatomy.heads
    )
    return _blend(animal.vertices, animal.bone, animal.weight, a_from_rest)


@njit(cache=True)
def _blend(vertices, bone, weight, motion):
    out = np.zeros((len(vertices), 3))
    for index in range(len(vertices)):
        for k in range(4):
            if weight[index, k] > 0:
                transform = motion[bone[index, k]]
                for axis in range(3):
                    moved = transform[axis, 3]
                    for other in range(3):
                        moved += transform[axis, other] * vertices[index, other]
                    out[index, axis] += weight[index, k] * moved
    return out


def normals_of(
    points: Float[np.ndarray, "vertex 3"], faces: Int[np.ndarray, "face 3"]
) -> Float[np.ndarray, "vertex 3"]:
    """Return unit vertex normals of a closed surface."""
    corner, vertex = points[faces], faces.ravel()
    normal = np.repeat(area_normals(corner), 3, axis=0)
    out = np.stack([np.bincount(vertex, part, len(points)) for part in normal.T], axis=-1)
    return out / np.maximum(np.linalg.norm(out, axis=-1, keepdims=True), 1e-12)
