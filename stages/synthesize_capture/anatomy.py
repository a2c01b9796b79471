"""A species as data: bones at rest, flesh around them, a coat and a gait.

`skeleton` mirrors the limbs of the left side. The 25 bones have the same names and order in all species:
fore limbs are wings where `Gait.wings` says so. Frame: `agent`, meters.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from jaxtyping import Float

Point = tuple[float, float, float]
BoneRow = tuple[str, str, Point, Point, tuple[float, float]]
"""name, parent, head, tail and the radii at both, meters"""
Coat = Callable[[np.ndarray, np.random.Generator], np.ndarray]
"""Linear RGB albedo and strength of the fine pattern ``[vertex 4]`` of vertices ``[vertex 3]``."""
SHADED = ("pelvis", "spine", "loin", "chest", "head", "left hand", "right hand", "left toes", "right toes")
"""Bones that cast the soft shadow on the ground."""


@dataclass(frozen=True)
class Bone:
    """A segment of the skeleton at rest, in the agent frame."""

    name: str
    parent: int
    head: Point
    tail: Point
    radius: tuple[float, float]


@dataclass(frozen=True)
class Flesh:
    """A rounded cone beside the bones: an ear, a cheek, a belly."""

    head: Point
    tail: Point
    radius: tuple[float, float]
    softness: float
    """Width of the smooth union with other parts, meters."""


@dataclass(frozen=True)
class Gait:
    """How a body stands, rests and moves, at the size of its bones; the cat's where nothing is given.

    Pairs are of fore and hind feet; places on the ground (x, z) are those of the left foot.
    """

    stand_m: float = 0.235
    """Height of the body's center above the ground when it stands at rest; likewise sitting and lying."""
    sit_m: float = 0.172
    lie_m: float = 0.105
    sit_pitch: float = -0.56
    """Radians; negative raises the head."""
    sole_m: float = 0.016
    """Height of a foot bone's head above the sole."""
    walk_offset: tuple[float, ...] = (0.75, 0.25, 0.5, 0.0)
    """Phase of left and right fore foot, left and right hind foot, in strides."""
    trot_offset: tuple[float, ...] = (0.5, 0.0, 0.0, -0.5)
    duty: Point = (0.70, 0.36, 0.68)
    """Duty factor (share of the stride in stance): standing still, minimum, maximum."""
    forward: tuple[float, float] = (0.0, 0.03)
    """Distance in front of their rest positions at which feet are placed."""
    sitting: tuple[tuple[float, float], tuple[float, float]] = ((0.036, 0.105), (0.075, -0.05))
    lying: tuple[tuple[float, float], tuple[float, float]] = ((0.05, 0.19), (0.095, -0.08))
    eye: Point = (0.0, 0.1, 0.2)
    fold_m: float = 0.20
    """Below this distance from hip to toes the hock folds."""
    hop_m: float = 0.0
    """Height by which the body rises in the flight phase of a stride."""
    hop_pitch: float = 0.0
    """Pitch of the body at take-off, radians."""
    nod: float = 0.0
    """Swing of the neck at every step that keeps the head still (head bobbing), radians."""
    flex: float = 1.0
    """Flexibility of the back and tail relative to a cat's."""
    tail_sway: float = 1.0
    wings: bool = False


@dataclass(frozen=True)
class Anatomy:
    """A species: what `animal.grow` makes a surface of and `gait.poses` moves."""

    name: str
    bones: tuple[Bone, ...]
    flesh: tuple[Flesh, ...]
    coat: Coat
    gait: Gait = field(default_factory=Gait)
    size: float = 1.0
    """Scale of the bones in `bones`."""
    box: tuple[tuple[float, float], ...] = ((-0.13, 0.131), (-0.26, 0.19), (-0.54, 0.36))
    """Bounds of the surface along x, y and z."""
    shadow_balls: tuple[tuple[str, Point, float], ...] = ()
    """Bone, rest point and radius of the balls that cast the soft shadow; empty: from `SHADED` bones."""

    @cached_property
    def heads(self) -> Float[np.ndarray, "bone 3"]:
        """Heads of the bones at rest."""
        return np.array([bone.head for bone in self.bones], float)

    def balls(self) -> tuple[tuple[str, Point, float], ...]:
        """Return the balls that cast the soft shadow on the ground."""
        found = tuple(
            (bone.name, tuple(np.add(bone.head, bone.tail) / 2), float(np.mean(bone.radius)))
            for bone in self.bones
            if bone.name in SHADED
        )
        return self.shadow_balls or found


def skeleton(trunk: Iterable[BoneRow], left: Iterable[BoneRow]) -> tuple[Bone, ...]:
    """Return the bones of a trunk, of limbs on the left, and of their mirror images."""
    rows = [*trunk]
    for side, sign in (("left", 1.0), ("right", -1.0)):
        for name, parent, head, tail, radius in left:
            above = parent if parent in ("chest", "pelvis") else f"{side} {parent}"
            rows.append((f"{side} {name}", above, _mirrored(head, sign), _mirrored(tail, sign), radius))
    names = [row[0] for row in rows]
    return tuple(
        Bone(name, names.index(parent) if parent else -1, head, tail, radius)
        for name, parent, head, tail, radius in rows
    )


def tail_rows(start: Point, step: Point, droop: float, radius: Point) -> list[BoneRow]:
    """Return five bones of a tail: each ``step`` long, turning down by ``droop`` meters more than the last.

    ``radius`` is that at the root, at the end of the first bone, and how much it falls per bone.
    """
    rows: list[BoneRow] = []
    for index in range(5):
        end = (start[0] + step[0], start[1] + step[1] - droop * index, start[2] + step[2])
        thick = (radius[0] - radius[2] * index, radius[1] - radius[2] * index)
        rows.append((f"tail {index + 1}", f"tail {index}" if index else "pelvis", start, end, thick))
        start = end
    return rows


def both_sides(*left: Flesh) -> tuple[Flesh, ...]:
    """Return flesh of the right side and of the left."""
    return tuple(
        Flesh(_mirrored(part.head, sign), _mirrored(part.tail, sign), part.radius, part.softness)
        for sign in (-1.0, 1.0)
        for part in left
    )


def _mirrored(point: Point, sign: float) -> Point:
    return (sign * point[0], point[1], point[2])
