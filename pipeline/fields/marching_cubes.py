"""Extract triangle meshes from fields by marching cubes, with colors read from the field."""

from collections.abc import Callable

import numpy as np
import torch
import trimesh
from jaxtyping import Bool, Float
from skimage import measure
from torch import Tensor

from pipeline.fields.fields import Field
from pipeline.geometry.meshes import Mesh

CHUNK = 1 << 18
"""points evaluated at once"""


@torch.no_grad()
def sample_distance(
    distance: Callable[[Float[Tensor, "point 3"]], Float[Tensor, "point"]],
    low_m: Float[Tensor, "3"],
    high_m: Float[Tensor, "3"],
    step_m: float,
) -> Float[np.ndarray, "x y z"]:
    """Evaluate a signed distance on a regular lattice that starts at ``low_m``."""
    nodes = ((high_m - low_m) / step_m).ceil().int().tolist()
    axes = [low_m[axis] + torch.arange(nodes[axis] + 1, device=low_m.device) * step_m for axis in range(3)]
    values = []
    for slab in axes[0].split(max(1, CHUNK // (len(axes[1]) * len(axes[2])))):
        points = torch.stack(torch.meshgrid(slab, axes[1], axes[2], indexing="ij"), dim=-1)
        values.append(distance(points.view(-1, 3)).view(points.shape[:-1]))
    return torch.cat(values).cpu().numpy()


def zero_level(volume: Float[np.ndarray, "x y z"], low_m: Float[np.ndarray, "3"], step_m: float) -> Mesh:
    """Return the surface where the signed distance is 0, faces turned towards positive distance."""
    if not volume.min() < 0 < volume.max():
        return Mesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32))
    vertices, faces, _, _ = measure.marching_cubes(
        volume, 0.0, spacing=(step_m,) * 3, gradient_direction="descent"
    )
    return Mesh((vertices + low_m).astype(np.float32), faces.astype(np.int32))


@torch.no_grad()
def paint(field: Field, mesh: Mesh, code: int) -> Mesh:
    """Return the mesh with the field's color at its vertices."""
    points = torch.from_numpy(mesh.vertices).to(field.log_beta.device)
    color = field.color_and_feature(
        field.encode(points, torch.full((len(points),), code, device=points.device))
    )[0]
    return Mesh(mesh.vertices, mesh.faces, (color * 255 + 0.5).byte().cpu().numpy())


def extract_scene(field: Field, code: int, step_m: float) -> Mesh:
    """Return the scene's surface for one video's code (-1: the shared scene), colored."""
    low, high = _box(field)
    volume = sample_distance(
        lambda points: field.distance_at(points, torch.full((len(points),), code, device=points.device)),
        low,
        high,
        step_m,
    )
    return paint(field, zero_level(volume, low.cpu().numpy(), step_m), code)


@torch.no_grad()
def extract_moved(field: Field, code: int) -> Mesh:
    """Return the surfaces of one video that the shared scene does not have, colored."""
    assert field.fused is not None, "only fused scenes differ from video to video"
    pieces, count = [Mesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32))], 0
    for low, distance in zip(*field.fused.own_blocks(code), strict=True):
        piece = zero_level(distance.cpu().numpy(), low.cpu().numpy(), field.fused.voxel_m)
        pieces.append(Mesh(piece.vertices, piece.faces + count))
        count += len(piece.vertices)
    mesh = Mesh(
        *(np.concatenate([getattr(piece, name) for piece in pieces]) for name in ("vertices", "faces"))
    )
    return paint(field, keep_vertices(mesh, ~on_surface(field, mesh.vertices, -1)), code)


@torch.no_grad()
def on_surface(field: Field, points: Float[np.ndarray, "point 3"], code: int) -> Bool[np.ndarray, "point"]:
    """Return which points lie within half a truncation of a surface of a video's scene (-1: the shared)."""
    assert field.fused is not None, "only fused scenes have a truncation of their own"
    at = torch.from_numpy(np.asarray(points, np.float32)).to(field.log_beta.device)
    distance_m = field.distance_at(at, torch.full((len(at),), code, device=at.device))
    return (distance_m.abs() < field.fused.truncation_m / 2).cpu().numpy()


def extract_agent(field: Field, step_m: float) -> Mesh:
    """Return the agent's surface at rest: closed, one piece (the largest), colored."""
    low, high = _box(field)
    volume = sample_distance(lambda points: field.distance(field.encode(points)), low, high, step_m)
    closed = np.pad(volume, 1, constant_values=step_m)
    mesh = zero_level(closed, low.cpu().numpy() - step_m, step_m)
    pieces = trimesh.graph.connected_components(
        trimesh.Trimesh(mesh.vertices, mesh.faces, process=False).edges_unique,
        nodes=np.arange(len(mesh.vertices)),
    )
    return paint(field, keep_vertices(mesh, np.isin(np.arange(len(mesh.vertices)), max(pieces, key=len))), -1)


def keep_vertices(mesh: Mesh, keep: Bool[np.ndarray, "vertex"]) -> Mesh:
    """Return the mesh restricted to the kept vertices and the faces between them."""
    index = np.cumsum(keep) - 1
    faces = index[mesh.faces[keep[mesh.faces].all(-1)]].astype(np.int32)
    return Mesh(mesh.vertices[keep], faces, None if mesh.color is None else mesh.color[keep])


def _box(field: Field) -> tuple[Tensor, Tensor]:
    like = field.log_beta.detach()
    return like.new_tensor(field.shape.low_m), like.new_tensor(field.shape.high_m)
