"""Sheets: the room is made of textured grids of points, each with its own picture.

A sheet's grid runs like its picture: columns along u (right), rows along v (down), seen from its front.
Walls, box sides, cylinders, cushions, curtains and leaves are all sheets, so one baker and one
renderer serve everything. Frames: object or world axes, +y up, meters.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int, UInt8

from pipeline.geometry import rigid

Paint = Callable[[float, float], UInt8[np.ndarray, "height width 3"]]
"""Draws the picture of a sheet of the given width and height in meters (sRGB albedo)."""


@dataclass(frozen=True)
class Sheet:
    """A grid of points with a picture; ``glow`` > 0 makes it shine by itself instead of reflecting."""

    points: Float[np.ndarray, "row column 3"]
    picture: UInt8[np.ndarray, "height width 3"]
    glow: float = 0.0

    def size_m(self) -> tuple[float, float]:
        """Return (height, width) along the middle of the grid."""
        down = np.linalg.norm(np.diff(self.points, axis=0), axis=-1).sum(0).mean()
        right = np.linalg.norm(np.diff(self.points, axis=1), axis=-1).sum(1).mean()
        return float(down), float(right)

    def normals(self) -> Float[np.ndarray, "row column 3"]:
        """Return unit normals that point to the front."""
        normal = np.cross(np.gradient(self.points, axis=0), np.gradient(self.points, axis=1))
        return normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)

    def moved(self, world_from_object: Float[np.ndarray, "4 4"]) -> "Sheet":
        """Return the sheet with its points moved by a rigid motion."""
        return replace(self, points=rigid.apply(world_from_object, self.points).astype(np.float32))


def upright(x: float, z: float, yaw: float = 0.0, y: float = 0.0) -> Float[np.ndarray, "4 4"]:
    """Return the motion that turns an object by ``yaw`` about +y and puts it at (x, y, z)."""
    return rigid.make(rigid.rotation_from_vector(np.array([0.0, yaw, 0.0])), np.array([x, y, z]))


def flat(corner, right, down, paint: Paint, *, glow: float = 0.0) -> Sheet:
    """Make a rectangle from its top left corner and its two edges as seen from the front."""
    corner, right, down = (np.asarray(part, float) for part in (corner, right, down))
    v, u = np.meshgrid((0.0, 1.0), (0.0, 1.0), indexing="ij")
    points = corner + v[..., None] * down + u[..., None] * right
    picture = paint(float(np.linalg.norm(right)), float(np.linalg.norm(down)))
    return Sheet(points.astype(np.float32), picture, glow)


def box(center, size, paint: Paint | dict[str, Paint], *, skip: str = "") -> list[Sheet]:
    """Make an upright box; ``paint`` may be by face (``+x``, "" = the rest), ``skip`` omits faces."""
    center, half = np.asarray(center, float), np.asarray(size, float) / 2
    sheets = []
    for name in ("+x", "-x", "+y", "-y", "+z", "-z"):
        if name in skip.split():
            continue
        normal = float(f"{name[0]}1") * np.eye(3)["xyz".index(name[1])]
        up = np.array([0.0, 1.0, 0.0]) if normal[1] == 0 else np.array([0.0, 0.0, -normal[1]])
        right = np.cross(up, normal)
        high, wide = half @ np.abs(up), half @ np.abs(right)
        corner = center + half * normal + high * up - wide * right
        chosen = paint.get(name, paint[""]) if isinstance(paint, dict) else paint
        sheets.append(flat(corner, 2 * wide * right, -2 * high * up, chosen))
    return sheets


def cushion(center, size, paint: Paint, *, bulge: float, skip: str = "-y") -> list[Sheet]:
    """Make a box whose faces bulge softly outwards by ``bulge`` meters."""
    soft = []
    for sheet in box(center, size, paint, skip=skip):
        corner = sheet.points[0, 0]
        right = sheet.points[0, 1] - sheet.points[0, 0]
        down = sheet.points[1, 0] - sheet.points[0, 0]
        v, u = np.meshgrid(np.linspace(0, 1, 7), np.linspace(0, 1, 7), indexing="ij")
        rise = bulge * (np.sin(np.pi * u) * np.sin(np.pi * v)) ** 0.6
        points = corner + v[..., None] * down + u[..., None] * right + rise[..., None] * sheet.normals()[0, 0]
        soft.append(replace(sheet, points=points.astype(np.float32)))
    return soft


def cylinder(
    center, radius: float, height: float, side: Paint, top: Paint, *, flare: float = 1.0, segments: int = 16
) -> list[Sheet]:
    """Make a standing cylinder whose top radius is ``flare`` times the bottom one, with a lid."""
    angle = np.linspace(0, 2 * np.pi, segments + 1)
    ring = np.stack([np.sin(angle), np.zeros_like(angle), np.cos(angle)], axis=-1)
    half = np.array([0, height / 2, 0])
    low, high = np.asarray(center, float) - half, np.asarray(center, float) + half
    rim, around = high + ring * radius * flare, 2 * np.pi * radius
    wall = np.stack([rim, low + ring * radius]).astype(np.float32)
    disc = np.stack([np.broadcast_to(high, ring.shape), rim]).astype(np.float32)
    return [Sheet(wall, side(around, height)), Sheet(disc, top(around, radius))]


def curtain(corner, right, height: float, paint: Paint, *, depth: float, folds: int) -> Sheet:
    """Make a hanging cloth from its top left corner along ``right``, in waves of ``depth`` meters."""
    corner, right = np.asarray(corner, float), np.asarray(right, float)
    u = np.linspace(0, 1, folds * 4 + 1)
    out = np.cross(right, [0, 1.0, 0]) / np.linalg.norm(right)
    line = corner + u[:, None] * right + (depth * np.sin(2 * np.pi * folds * u))[:, None] * -out
    points = np.stack([line, line - [0, height, 0]])
    return Sheet(points.astype(np.float32), paint(float(np.linalg.norm(right)), height))


def ball(center, radius: float, paint: Paint) -> Sheet:
    """Make a ball."""
    latitude, longitude = np.linspace(0.02, np.pi - 0.02, 8), np.linspace(0, 2 * np.pi, 15)
    polar, angle = np.meshgrid(latitude, longitude, indexing="ij")
    unit = [np.sin(polar) * np.sin(angle), np.cos(polar), np.sin(polar) * np.cos(angle)]
    points = np.asarray(center, float) + radius * np.stack(unit, axis=-1)
    return Sheet(points.astype(np.float32), paint(2 * np.pi * radius, np.pi * radius))


def triangles(
    sheets: Sequence[Sheet],
) -> tuple[
    Float[np.ndarray, "vertex 3"],
    Int[np.ndarray, "face 3"],
    Float[np.ndarray, "vertex 2"],
    Int[np.ndarray, "face"],
]:
    """Join sheets to one mesh.

    Returns vertices (meters), faces (counter-clockwise from the front), picture coordinates in [0, 1], and
    each face's sheet.
    """
    vertices, faces, coordinates, owner, start = [], [], [], [], 0
    for index, sheet in enumerate(sheets):
        rows, columns, _ = sheet.points.shape
        at = start + np.arange(rows * columns).reshape(rows, columns)
        a, b, c, d = at[:-1, :-1].ravel(), at[:-1, 1:].ravel(), at[1:, :-1].ravel(), at[1:, 1:].ravel()
        faces.append(np.concatenate([np.stack([a, c, b], -1), np.stack([b, c, d], -1)]))
        v, u = np.meshgrid(np.linspace(0, 1, rows), np.linspace(0, 1, columns), indexing="ij")
        coordinates.append(np.stack([u, v], -1).reshape(-1, 2))
        vertices.append(sheet.points.reshape(-1, 3))
        owner.append(np.full(len(faces[-1]), index))
        start += rows * columns
    return (
        np.concatenate(vertices).astype(np.float32),
        np.concatenate(faces).astype(np.int32),
        np.concatenate(coordinates).astype(np.float32),
        np.concatenate(owner).astype(np.int32),
    )
