"""Mesh decimation by edge collapse, with colors and vertex correspondence."""

import fast_simplification
import numpy as np
from jaxtyping import Int
from scipy.spatial import KDTree

from pipeline.geometry.meshes import Mesh


def decimate(mesh: Mesh, max_faces: int) -> tuple[Mesh, Int[np.ndarray, " vertex"]]:
    """Collapse edges until `max_faces` are left; also return, per new vertex, the nearest old one."""
    if len(mesh.faces) <= max_faces:
        return mesh, np.arange(len(mesh.vertices))
    vertices, faces = fast_simplification.simplify(
        np.ascontiguousarray(mesh.vertices, np.float64),
        np.ascontiguousarray(mesh.faces, np.int32),
        target_count=max_faces,
    )[:2]
    nearest = np.asarray(KDTree(mesh.vertices).query(vertices)[1])
    color = None if mesh.color is None else mesh.color[nearest]
    return Mesh(vertices.astype(np.float32), faces.astype(np.int32), color), nearest
