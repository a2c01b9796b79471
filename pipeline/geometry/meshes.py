"""Triangle meshes and rays: `Mesh`, `RayCaster` with Embree, and `render_view`, which draws depth."""

from dataclasses import dataclass

import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from jaxtyping import Float, Int, Num, UInt8

from pipeline.geometry import cameras


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh in one frame, meters."""

    vertices: Float[np.ndarray, "vertex 3"]
    faces: Int[np.ndarray, "face 3"]
    color: UInt8[np.ndarray, "vertex 3"] | None = None

    def face_areas(self) -> Float[np.ndarray, "face"]:
        """Return the area of each face, square meters."""
        return np.linalg.norm(area_normals(self.vertices[self.faces].astype(np.float64)), axis=-1) / 2

    @property
    def area_m2(self) -> float:
        """Area of all faces, square meters."""
        return float(self.face_areas().sum())

    def face_normals(self) -> Float[np.ndarray, "face 3"]:
        """Return unit normals; zero for degenerate faces."""
        normal = area_normals(self.vertices[self.faces])
        return normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)

    def vertex_normals(self) -> Float[np.ndarray, "vertex 3"]:
        """Return unit normals, the area-weighted mean of the faces around each vertex."""
        weighted = area_normals(self.vertices[self.faces])
        normal = np.zeros_like(self.vertices, dtype=np.float64)
        for index in range(3):
            np.add.at(normal, self.faces[:, index], weighted)
        return normal / np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)


def area_normals(corner: Float[np.ndarray, "*face 3 3"]) -> Float[np.ndarray, "*face 3"]:
    """Return normals of triangles given by their corners, with length twice the area."""
    return np.cross(corner[..., 1, :] - corner[..., 0, :], corner[..., 2, :] - corner[..., 0, :])


@dataclass(frozen=True)
class Hits:
    """First hits of rays: ``distance`` in lengths of the direction (inf: miss), ``face`` (-1: miss)."""

    distance: Float[np.ndarray, "ray"]
    face: Int[np.ndarray, "ray"]
    barycentric: Float[np.ndarray, "ray 3"]

    def interpolate(
        self, mesh: Mesh, attribute: Num[np.ndarray, "vertex channel"]
    ) -> Float[np.ndarray, "ray channel"]:
        """Blend a vertex attribute at the hit points; rays that missed get face 0's and must be masked."""
        return np.einsum(
            "rk,rkc->rc", self.barycentric, attribute[mesh.faces[np.maximum(self.face, 0)]].astype(np.float32)
        )


class RayCaster:
    """Embree's acceleration structure over one mesh; build once, cast often."""

    def __init__(self, mesh: Mesh):
        self.mesh = mesh
        self._scene = EmbreeScene()
        self._geometry = TriangleMesh(
            self._scene, np.ascontiguousarray(mesh.vertices[mesh.faces], np.float32)
        )

    def cast(
        self,
        origins: Float[np.ndarray, "ray 3"] | Float[np.ndarray, "3"],
        directions: Float[np.ndarray, "ray 3"],
    ) -> Hits:
        """Return the first hit of each ray, from origins of its own or one of all, mesh frame, meters."""
        origins = np.ascontiguousarray(np.broadcast_to(origins, directions.shape), np.float32)
        found = self._scene.run(origins, np.ascontiguousarray(directions, np.float32), output=True)
        hit = found["primID"] >= 0
        u, v = found["u"], found["v"]
        return Hits(
            distance=np.where(hit, found["tfar"], np.inf).astype(np.float32),
            face=np.where(hit, found["primID"], -1).astype(np.int32),
            barycentric=np.stack([1 - u - v, u, v], axis=-1).astype(np.float32),
        )


def render_view(
    caster: RayCaster,
    world_from_camera: Float[np.ndarray, "4 4"],
    intrinsics: Float[np.ndarray, "3 3"],
    height: int,
    width: int,
) -> tuple[Float[np.ndarray, "height width"], Hits]:
    """Render z-depth (0 where nothing is hit) and the hits, row-major, of a camera looking at the mesh."""
    directions = (
        cameras.ray_directions(intrinsics, height, width).reshape(-1, 3) @ world_from_camera[:3, :3].T
    )
    hits = caster.cast(world_from_camera[:3, 3], directions)
    depth = np.where(hits.face >= 0, hits.distance, 0).astype(np.float32)
    return depth.reshape(height, width), hits
