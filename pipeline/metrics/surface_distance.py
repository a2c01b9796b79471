"""Exact point-to-mesh distances, and the chamfer distance of triangle meshes.

`TriangleSurface` splits large triangles, so that the piece nearest to a point is among those whose centers
are not much farther than the nearest center; trimesh does the geometry of single triangles.
"""

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree
from trimesh import triangles
from trimesh.remesh import subdivide_to_size

POINTS_AT_ONCE = 500
"""Bounds the memory of point-triangle pairs."""
EDGE_FACTOR = 3.0
"""Triangles are split until no edge exceeds this many times the side of a square of their mean area."""
HALVINGS = 20
"""Maximum rounds of splitting: a million times finer than the mesh."""


class TriangleSurface:
    """Triangles whose distance from points can be queried; build once, query often."""

    def __init__(self, corners: Float[np.ndarray, "face 3 3"]):
        area = triangles.area(corners)
        self.corners = split(corners[area > 0], EDGE_FACTOR * float(np.sqrt(area.mean())))
        center = self.corners.mean(1)
        self._reach = float(np.linalg.norm(self.corners - center[:, None], axis=-1).max())
        self._centers = KDTree(center)

    def sample(self, count: int, rng: np.random.Generator) -> Float[np.ndarray, "point 3"]:
        """Draw points uniformly over the surface, meters."""
        area = triangles.area(self.corners)
        face = rng.choice(len(area), count, p=area / area.sum())
        return (rng.dirichlet((1, 1, 1), count)[..., None] * self.corners[face]).sum(1)

    def distance(self, points: Float[np.ndarray, "point 3"]) -> Float[np.ndarray, "point"]:
        """Return the distance of each point from the surface, meters."""
        parts = [points[begin : begin + POINTS_AT_ONCE] for begin in range(0, len(points), POINTS_AT_ONCE)]
        return np.concatenate([self._distance(part) for part in parts])

    def _distance(self, points: Float[np.ndarray, "point 3"]) -> Float[np.ndarray, "point"]:
        nearest = _to_triangles(points, self.corners[self._centers.query(points)[1]])
        near = self._centers.query_ball_point(points, nearest + self._reach, return_sorted=False)
        point = np.repeat(np.arange(len(points)), [len(each) for each in near])
        face = np.concatenate(near).astype(int)
        np.minimum.at(nearest, point, _to_triangles(points[point], self.corners[face]))
        return nearest


def chamfer(ours: TriangleSurface, true: TriangleSurface, count: int, rng: np.random.Generator) -> float:
    """Return the mean of both mean distances from ``count`` points of one surface to the other, meters."""
    there, back = true.distance(ours.sample(count, rng)), ours.distance(true.sample(count, rng))
    return float((there.mean() + back.mean()) / 2)


def split(corners: Float[np.ndarray, "face 3 3"], longest_m: float) -> Float[np.ndarray, "piece 3 3"]:
    """Halve the edges of triangles until none is longer than ``longest_m``."""
    assert longest_m > 0, longest_m
    faces = np.arange(3 * len(corners)).reshape(-1, 3)
    vertices, faces, *_ = subdivide_to_size(corners.reshape(-1, 3), faces, longest_m, max_iter=HALVINGS)
    return vertices[faces]


def _to_triangles(
    points: Float[np.ndarray, "point 3"], corners: Float[np.ndarray, "point 3 3"]
) -> Float[np.ndarray, "point"]:
    """Return the distance of each point from its own triangle."""
    return np.linalg.norm(triangles.closest_point(corners, points) - points, axis=-1)
