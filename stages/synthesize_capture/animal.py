"""The animals: smooth watertight skinned surfaces with 25 bones and patterned fur, a cat and a dog.

`grow` blends rounded cones along the bones into a signed distance, extracts one surface by marching cubes,
and gives each vertex up to four bones. Frame: `agent`, origin at the body's centre, +y up, +z towards the
head, +x to its left, metres. At rest every bone's axes are the agent's; only its origin differs.
"""

from dataclasses import dataclass
from typing import Literal, assert_never

import numpy as np
from jaxtyping import Float, Int
from numba import njit
from skimage.measure import marching_cubes

Species = Literal["cat", "dog"]
DOG_SIZE = 1.3
"""Length of the dog's bones, in those of the cat."""
STAND_HEIGHT_M = 0.235
"""Height of the body's centre above the ground when it stands at rest."""


@dataclass(frozen=True)
class Bone:
    """A segment of the skeleton at rest, in the agent frame."""

    name: str
    parent: int
    head: tuple[float, float, float]
    tail: tuple[float, float, float]
    radius: tuple[float, float]


BoneRow = tuple[str, str, tuple[float, float, float], tuple[float, float, float], tuple[float, float]]
"""name, parent, head, tail and the radii at both, metres"""


def _limbs(side: int) -> list[BoneRow]:
    x, tag = (0.045, "left") if side > 0 else (-0.045, "right")
    f, h = x * 1.0, x * 1.1
    return [
        (f"{tag} upper arm", "chest", (f, -0.005, 0.115), (f * 1.15, -0.103, 0.075), (0.042, 0.027)),
        (f"{tag} forearm", f"{tag} upper arm", (f * 1.15, -0.103, 0.075), (f, -0.203, 0.112), (0.025, 0.018)),
        (f"{tag} hand", f"{tag} forearm", (f, -0.203, 0.112), (f, -0.219, 0.14), (0.019, 0.018)),
        (f"{tag} thigh", "pelvis", (h, 0.0, -0.155), (h * 1.25, -0.105, -0.115), (0.058, 0.034)),
        (
            f"{tag} shank",
            f"{tag} thigh",
            (h * 1.25, -0.105, -0.115),
            (h * 1.1, -0.148, -0.21),
            (0.031, 0.018),
        ),
        (f"{tag} foot", f"{tag} shank", (h * 1.1, -0.148, -0.21), (h * 1.1, -0.214, -0.178), (0.017, 0.016)),
        (f"{tag} toes", f"{tag} foot", (h * 1.1, -0.214, -0.178), (h * 1.1, -0.22, -0.148), (0.018, 0.017)),
    ]


def _skeleton() -> tuple[Bone, ...]:
    rows: list[BoneRow] = [
        ("pelvis", "spine", (0, 0.0, -0.10), (0, -0.005, -0.185), (0.072, 0.058)),
        ("spine", "loin", (0, 0.0, -0.02), (0, 0.0, -0.10), (0.073, 0.072)),
        ("loin", "", (0, 0.0, 0.0), (0, 0.0, 0.05), (0.074, 0.076)),
        ("chest", "loin", (0, 0.0, 0.05), (0, 0.012, 0.14), (0.078, 0.064)),
        ("neck", "chest", (0, 0.02, 0.15), (0, 0.075, 0.215), (0.05, 0.044)),
        ("head", "neck", (0, 0.088, 0.225), (0, 0.078, 0.285), (0.056, 0.030)),
    ]
    start = (0.0, 0.022, -0.20)
    for index in range(5):
        end = (0.0, start[1] - 0.006 * index, start[2] - 0.056)
        rows.append(
            (
                f"tail {index + 1}",
                "pelvis" if index == 0 else f"tail {index}",
                start,
                end,
                (0.021 - 0.0016 * index, 0.0195 - 0.0016 * index),
            )
        )
        start = end
    rows += [*_limbs(1), *_limbs(-1)]
    names = [row[0] for row in rows]
    return tuple(
        Bone(name, names.index(parent) if parent else -1, head, tail, radius)
        for name, parent, head, tail, radius in rows
    )


BONES = _skeleton()
INDEX = {bone.name: index for index, bone in enumerate(BONES)}
HEADS = np.array([bone.head for bone in BONES], float)
TAILS = np.array([bone.tail for bone in BONES], float)


@dataclass(frozen=True)
class Animal:
    """The skinned surface at rest, agent frame."""

    vertices: Float[np.ndarray, "vertex 3"]
    faces: Int[np.ndarray, "face 3"]
    bone: Int[np.ndarray, "vertex 4"]
    weight: Float[np.ndarray, "vertex 4"]
    fur: Float[np.ndarray, "vertex 4"]
    """Linear RGB albedo and how strongly the fine pattern shows."""
    size: float = 1.0
    """Its bones are so many times as long as `BONES`."""


def grow(rng: np.random.Generator, *, cell_m: float = 0.013, species: Species = "cat") -> Animal:
    """Make an animal; the generator chooses its coat."""
    axes = [np.arange(low, high, cell_m) for low, high in ((-0.13, 0.131), (-0.26, 0.19), (-0.54, 0.36))]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    distance = _body_distance(points.reshape(-1, 3))
    match species:
        case "cat":
            coat, size = _tabby, 1.0
        case "dog":
            distance, coat, size = _with_dogs_head(distance, points.reshape(-1, 3)), _patched, DOG_SIZE
        case _:
            assert_never(species)
    distance = distance.reshape(points.shape[:3])
    vertices, faces, _, _ = marching_cubes(distance, 0.0, spacing=(cell_m,) * 3)
    vertices = vertices + np.array([axis[0] for axis in axes])
    bone, weight = _skin(vertices)
    shown = (size * vertices).astype(np.float32)
    return Animal(shown, faces.astype(np.int32), bone, weight, coat(vertices, rng), size)


def _body_distance(points: Float[np.ndarray, "point 3"]) -> Float[np.ndarray, "point"]:
    """Return the smooth union of all bones' cones, ears, cheeks and muzzle (polynomial smooth minimum)."""
    parts = [_cone(points, HEADS[k], TAILS[k], *BONES[k].radius) for k in range(len(BONES))]
    sharpness = [0.03] * 6 + [0.012] * 5 + [0.024, 0.012, 0.008, 0.03, 0.014, 0.008, 0.008] * 2
    for side in (-1, 1):
        ear = _cone(
            points,
            np.array([side * 0.030, 0.125, 0.225]),
            np.array([side * 0.040, 0.168, 0.216]),
            0.020,
            0.0065,
        )
        cheek = _cone(
            points,
            np.array([side * 0.022, 0.068, 0.262]),
            np.array([side * 0.014, 0.064, 0.283]),
            0.026,
            0.018,
        )
        parts += [ear, cheek]
        sharpness += [0.008, 0.012]
    parts.append(_cone(points, np.array([0, -0.025, -0.08]), np.array([0, -0.022, 0.07]), 0.06, 0.064))
    sharpness.append(0.03)
    total = parts[0]
    for part, soft in zip(parts[1:], sharpness[1:], strict=True):
        mix = np.maximum(soft - np.abs(total - part), 0) / soft
        total = np.minimum(total, part) - mix * mix * soft / 4
    return total


def _cone(
    points: np.ndarray, head: np.ndarray, tail: np.ndarray, head_radius: float, tail_radius: float
) -> np.ndarray:
    axis = tail - head
    along = np.clip((points - head) @ axis / (axis @ axis), 0, 1)
    return np.linalg.norm(points - head - along[:, None] * axis, axis=-1) - (
        head_radius + along * (tail_radius - head_radius)
    )


def _skin(
    vertices: Float[np.ndarray, "vertex 3"],
) -> tuple[Int[np.ndarray, "vertex 4"], Float[np.ndarray, "vertex 4"]]:
    """Weigh bones by a soft minimum of their distances; far limbs of the other side never mix in."""
    distance = np.stack(
        [_cone(vertices, HEADS[k], TAILS[k], *BONES[k].radius) for k in range(len(BONES))], axis=-1
    )
    score = np.exp(-np.maximum(distance - distance.min(1, keepdims=True), 0) / 0.009)
    for name, sign in (("left", 1), ("right", -1)):
        limb = [index for index, bone in enumerate(BONES) if bone.name.startswith(name)]
        score[:, limb] *= 1 / (1 + np.exp(-np.clip(sign * vertices[:, :1] / 0.006, -30, 30)))
    bone = np.argsort(-score, axis=1, kind="stable")[:, :4]
    weight = np.take_along_axis(score, bone, axis=1)
    weight[weight < 0.01 * weight[:, :1]] = 0
    return bone.astype(np.int32), (weight / weight.sum(1, keepdims=True)).astype(np.float32)


def _with_dogs_head(
    distance: Float[np.ndarray, "point"], points: Float[np.ndarray, "point 3"]
) -> Float[np.ndarray, "point"]:
    """Add a long muzzle and hanging ears to a body, and fill the waist."""
    parts = [(_cone(points, np.array([0, 0.07, 0.27]), np.array([0, 0.058, 0.312]), 0.034, 0.021), 0.014)]
    parts += [(_cone(points, np.array([0, -0.012, -0.1]), np.array([0, -0.012, 0.09]), 0.085, 0.09), 0.03)]
    for side in (-1, 1):
        top, tip = np.array([side * 0.046, 0.128, 0.222]), np.array([side * 0.074, 0.045, 0.228])
        parts.append((_cone(points, top, tip, 0.017, 0.024), 0.008))
    for part, soft in parts:
        mix = np.maximum(soft - np.abs(distance - part), 0) / soft
        distance = np.minimum(distance, part) - mix * mix * soft / 4
    return distance


def _patched(
    vertices: Float[np.ndarray, "vertex 3"], rng: np.random.Generator
) -> Float[np.ndarray, "vertex 4"]:
    """Draw a white coat with large black patches, a black saddle and ears, and a brown face."""
    x, y, z = vertices.T
    white, black, brown = (
        np.array([0.74, 0.72, 0.68]),
        np.array([0.022, 0.02, 0.02]),
        np.array([0.33, 0.15, 0.05]),
    )
    phase = rng.uniform(0, 2 * np.pi, 4)
    patch = np.sin(z / 0.05 + phase[0]) + np.sin(y / 0.04 + phase[1]) * np.sin(x / 0.05 + phase[2])
    saddle = 2.2 * np.clip((y - 0.01) / 0.05, -1, 1) * ((z > -0.2) & (z < 0.14))
    dark = np.clip((0.6 * patch + saddle - 0.2) * 4, 0, 1) * (y > -0.12)
    dark = np.maximum(dark, np.clip((np.abs(x) - 0.048) / 0.006, 0, 1) * (z > 0.19) * (y > 0.02))
    dark = np.maximum(dark, (z < -0.23) * np.clip(np.sin(z / 0.03 + phase[3]) * 3, 0, 1))
    color = white * (1 - dark[:, None]) + black * dark[:, None]
    face = ((z > 0.2) & (np.abs(x) > 0.016) & (z < 0.29) & (dark < 0.5))[:, None]
    color = np.where(face, brown, color)
    color[(z > 0.325) & (y > 0.05)] = black
    return np.concatenate([color, 0.35 * np.ones((len(vertices), 1))], axis=-1).astype(np.float32)


def _tabby(
    vertices: Float[np.ndarray, "vertex 3"], rng: np.random.Generator
) -> Float[np.ndarray, "vertex 4"]:
    """Draw a mackerel tabby: dark stripes across back, legs and tail, pale belly, muzzle and paws."""
    x, y, z = vertices.T
    ground = np.array([0.36, 0.22, 0.115]) * rng.uniform(0.8, 1.15)
    dark, pale = np.array([0.045, 0.032, 0.026]), np.array([0.72, 0.66, 0.56])
    phase = rng.uniform(0, 2 * np.pi, 6)
    wobble = (
        0.9 * np.sin(9 * y / 0.1 + phase[0])
        + 0.8 * np.sin(x / 0.022 + phase[1])
        + 0.6 * np.sin(z / 0.05 + phase[2])
    )
    body = np.sin(2 * np.pi * z / 0.052 + wobble)
    tail = np.sin(2 * np.pi * z / 0.045 + phase[3])
    leg = np.sin(2 * np.pi * y / 0.042 + 0.5 * np.sin(z / 0.02 + phase[4]))
    wave = np.where(z < -0.21, tail, np.where(y < -0.1, leg, body))
    stripe = np.clip((wave - 0.05) * 2.2, 0, 1) * np.where((y < -0.045) & (y > -0.1), 0.45, 1.0)
    blotch = np.clip(np.sin(x / 0.03 + phase[5]) * np.sin(z / 0.06 + phase[0]) * 1.5, 0, 1)
    light_part = np.clip((-y - 0.055) / 0.025, 0, 1) * (y > -0.11) * (np.abs(x) < 0.05)
    light_part = np.maximum(light_part, np.clip((-y - 0.19) / 0.012, 0, 1))
    light_part = np.maximum(
        light_part, np.clip((z - 0.262) / 0.015, 0, 1) * np.clip((0.085 - y) / 0.015, 0, 1)
    )
    light_part = np.maximum(
        light_part, np.clip((z - 0.13) / 0.03, 0, 1) * np.clip((0.0 - y) / 0.03, 0, 1) * (y > -0.1)
    )
    color = ground * (1 - 0.25 * blotch[:, None]) * (1 - stripe[:, None]) + dark * stripe[:, None]
    color = color * (1 - light_part[:, None]) + pale * light_part[:, None]
    face = np.stack([np.abs(x) - 0.024, y - 0.094, z - 0.273], axis=-1)
    color[np.linalg.norm(face, axis=-1) < 0.0115] = (0.28, 0.36, 0.06)
    color[(z > 0.3) & (np.abs(x) < 0.008) & (y > 0.07)] = (0.35, 0.12, 0.1)
    return np.concatenate([color, 0.55 * np.ones((len(vertices), 1))], axis=-1).astype(np.float32)


def surface(animal: Animal, a_from_bone: Float[np.ndarray, "bone 4 4"]) -> Float[np.ndarray, "vertex 3"]:
    """Blend the bones' motions linearly and return the vertices in frame a (at rest, bones sit at their
    heads).
    """
    a_from_rest = a_from_bone.copy()
    a_from_rest[:, :3, 3] -= np.einsum("bij,bj->bi", a_from_bone[:, :3, :3], animal.size * HEADS)
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


@njit(cache=True)
def normals_of(points, faces):
    """Return unit vertex normals ``[vertex 3]`` of a closed surface."""
    out = np.zeros_like(points)
    for index in range(len(faces)):
        a, b, c = points[faces[index, 0]], points[faces[index, 1]], points[faces[index, 2]]
        u, v = b - a, c - a
        for axis in range(3):
            normal = u[(axis + 1) % 3] * v[(axis + 2) % 3] - u[(axis + 2) % 3] * v[(axis + 1) % 3]
            for k in range(3):
                out[faces[index, k], axis] += normal
    for index in range(len(out)):
        length = np.sqrt(out[index, 0] ** 2 + out[index, 1] ** 2 + out[index, 2] ** 2)
        for axis in range(3):
            out[index, axis] /= max(length, 1e-12)
    return out
