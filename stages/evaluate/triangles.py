"""Surfaces as triangles: points drawn on them, and how far points lie from them, exactly.

`Surface` cuts large triangles into pieces of about one size, so that the piece that is nearest to a point is among those
whose centres are not much farther than the nearest centre.
"""

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import KDTree

from pipeline.space.meshes import Mesh

POINTS_AT_ONCE = 500
"""bounds the memory of pairs of points and triangles"""


class Surface:
    """Triangles that can be asked; build once, ask often."""

    def __init__(self, corner: Float[np.ndarray, "face 3 3"]):
        self.corner = cut(corner, 3 * np.sqrt(_areas(corner).mean()))
        centre = self.corner.mean(1)
        self._reach = float(np.linalg.norm(self.corner - centre[:, None], axis=-1).max())
        self._centres = KDTree(centre)

    @classmethod
    def of(cls, mesh: Mesh) -> "Surface":
        """Take the faces of a mesh."""
        return cls(corners(mesh))

    def sample(self, count: int, rng: np.random.Generator) -> Float[np.ndarray, "point 3"]:
        """Draw points evenly over the surface."""
        area = _areas(self.corner)
        face = rng.choice(len(area), count, p=area / area.sum())
        return (rng.dirichlet((1, 1, 1), count)[..., None] * self.corner[face]).sum(1)

    def distance(self, points: Float[np.ndarray, "point 3"]) -> Float[np.ndarray, "point"]:
        """Return how far each point is from the surface."""
        parts = [points[begin : begin + POINTS_AT_ONCE] for begin in range(0, len(points), POINTS_AT_ONCE)]
        return np.concatenate([self._distance(part) for part in parts])

    def _distance(self, points: Float[np.ndarray, "point 3"]) -> Float[np.ndarray, "point"]:
        found = to_triangles(points, self.corner[self._centres.query(points)[1]])
        near = self._centres.query_ball_point(points, found + self._reach, return_sorted=False)
        asked = np.repeat(np.arange(len(points)), [len(each) for each in near])
        np.minimum.at(found, asked, to_triangles(points[asked], self.corner[np.concatenate(near).astype(int)]))
        return found


def corners(mesh: Mesh) -> Float[np.ndarray, "face 3 3"]:
    """Return the corners of all faces."""
    return mesh.vertices[mesh.faces].astype(np.float64)


def cut(corner: Float[np.ndarray, "face 3 3"], longest_m: float) -> Float[np.ndarray, "piece 3 3"]:
    """Halve the longest edges of triangles until none is longer."""
    assert longest_m > 0, longest_m
    pieces = []
    while len(corner):
        edge = np.linalg.norm(np.roll(corner, -1, axis=1) - corner, axis=-1)
        short = edge.max(1) <= longest_m
        pieces.append(corner[short])
        order = (edge[~short].argmax(1)[:, None] + np.arange(3)) % 3
        first, second, third = np.take_along_axis(corner[~short], order[..., None], axis=1).swapaxes(0, 1)
        middle = (first + second) / 2
        corner = np.concatenate([np.stack(half, axis=1) for half in ((first, middle, third), (middle, second, third))])
    return np.concatenate(pieces)


def to_triangles(points: Float[np.ndarray, "point 3"], corner: Float[np.ndarray, "point 3 3"]) -> Float[np.ndarray, "point"]:
    """Return how far each point is from its triangle: from the plane where it is above the inside, else from the nearest edge."""
    edge, away = np.roll(corner, -1, axis=1) - corner, points[:, None] - corner
    share = (away * edge).sum(-1) / np.maximum((edge**2).sum(-1), np.finfo(float).tiny)
    rim = np.linalg.norm(away - np.clip(share, 0, 1)[..., None] * edge, axis=-1).min(1)
    normal = np.cross(edge[:, 0], edge[:, 1])
    length = np.linalg.norm(normal, axis=-1)
    inside = _above(away, edge, normal) & (length > 0)
    return np.where(inside, np.abs((away[:, 0] * normal).sum(-1)) / np.where(inside, length, 1), rim)


def _above(
    away: Float[np.ndarray, "point 3 3"], edge: Float[np.ndarray, "point 3 3"], normal: Float[np.ndarray, "point 3"]
) -> Bool[np.ndarray, "point"]:
    """Tell which points lie on the inner side of all three edges."""
    return ((np.cross(normal[:, None], edge) * away).sum(-1) >= 0).all(1)


def _areas(corner: Float[np.ndarray, "face 3 3"]) -> Float[np.ndarray, "face"]:
    return np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1) / 2
