"""Make surfaces ready for a page: find the floor and the extent, orient faces, shrink splats."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int, UInt8

from pipeline.fields.gaussians import BAND0, OPACITY, ROTATION, SCALE
from pipeline.geometry.ground import LEVEL_SURFACE, lowest_level
from pipeline.geometry.meshes import Mesh, area_normals

_SPLAT_ROW = np.dtype(
    [("position", "<f4", 3), ("scale", "<f4", 3), ("color", "u1", 4), ("rotation", "u1", 4)]
)
_STEPS = 8192.0  # places and sizes are rounded to 0.06 mm: finer digits do not compress


@dataclass(frozen=True)
class RoomExtent:
    """The room as a place to move in: world frame, meters."""

    floor_m: float
    bounds_m: Float[np.ndarray, "2 3"]


def extent(mesh: Mesh, agent_positions_world: Float[np.ndarray, "frame 3"]) -> RoomExtent:
    """Find the floor below the agent, and the box of all but the stray 0.5 % of vertices at each end."""
    bounds_m = np.percentile(mesh.vertices, [0.5, 99.5], axis=0)
    return RoomExtent(floor_height_m(mesh, agent_positions_world), bounds_m)


def floor_height_m(mesh: Mesh, agent_positions_world: Float[np.ndarray, "frame 3"]) -> float:
    """Find the height of the floor: the lowest level with a fair share of the upward area below the agent."""
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    normals = area_normals(corners)
    area = np.linalg.norm(normals, axis=1)
    height = corners[..., 1].mean(1)
    level = (normals[:, 1] > LEVEL_SURFACE * area) & (height < np.median(agent_positions_world[:, 1]))
    if not level.any():
        return float(np.percentile(mesh.vertices[:, 1], 2))
    return lowest_level(height[level], area[level])


def orient_towards(mesh: Mesh, inside: Float[np.ndarray, "3"]) -> Mesh:
    """Turn all faces so that most of the area faces a point inside: walls then vanish from behind."""
    corners = mesh.vertices[mesh.faces].astype(np.float64)
    normals = area_normals(corners)
    towards = np.einsum("fi,fi->f", normals, inside - corners.mean(1))
    if np.linalg.norm(normals, axis=1) @ np.sign(towards) >= 0:
        return mesh
    return Mesh(mesh.vertices, np.ascontiguousarray(mesh.faces[:, ::-1]), mesh.color)


@dataclass(frozen=True)
class SkinnedSplats:
    """The animal's Gaussians at rest, agent frame, and what moves them."""

    rows: bytes
    """32 bytes each: place, size, color with opacity, rotation"""
    skin: bytes
    """8 bytes each: four bones, four weights in 255ths"""


def splat_rows(gaussians: Float[np.ndarray, "point 62"], max_points: int) -> bytes:
    """Shrink Gaussian rows to 32 bytes: place, size, color with opacity, rotation; faint ones go first."""
    return _packed(gaussians[_weightiest(gaussians, max_points)])


def skinned_splats(
    gaussians: Float[np.ndarray, "point 62"], weights: Float[np.ndarray, "point bone"], max_points: int
) -> SkinnedSplats:
    """Shrink the animal's Gaussians likewise and keep each one's four heaviest bones."""
    selected = _weightiest(gaussians, max_points)
    joints = np.argsort(-weights[selected], axis=1, kind="stable")[:, :4]
    heaviest = np.take_along_axis(weights[selected], joints, 1)
    padding = ((0, 0), (0, 4 - joints.shape[1]))
    shares = _bytes(255 * heaviest / heaviest.sum(1, keepdims=True))
    skin = np.concatenate([np.pad(joints, padding), np.pad(shares, padding)], 1).astype(np.uint8)
    return SkinnedSplats(_packed(gaussians[selected]), skin.tobytes())


def _weightiest(gaussians: Float[np.ndarray, "point 62"], max_points: int) -> Int[np.ndarray, " selected"]:
    """Choose the valid Gaussians with the largest opacity times area, in descending order."""
    opacity, size = _opacity(gaussians), np.exp(gaussians[:, SCALE].astype(np.float64))
    sound = np.isfinite(gaussians).all(1) & (opacity >= 1 / 255)
    weight = np.where(sound, opacity * np.sort(size, axis=1)[:, 1:].prod(1), -1)
    return np.argsort(-weight, kind="stable")[: min(max_points, int(sound.sum()))]


def _packed(gaussians: Float[np.ndarray, "point 62"]) -> bytes:
    rows = np.zeros(len(gaussians), _SPLAT_ROW)
    rows["position"] = np.rint(gaussians[:, :3] * _STEPS) / _STEPS
    scale = np.exp(gaussians[:, SCALE].astype(np.float64))
    rows["scale"] = np.maximum(np.rint(scale * _STEPS), 1) / _STEPS
    color = gaussians[:, 6:9] * BAND0 + 0.5
    rows["color"] = _bytes(np.concatenate([color, _opacity(gaussians)[:, None]], 1) * 255)
    rotation = gaussians[:, ROTATION] / np.linalg.norm(gaussians[:, ROTATION], axis=1, keepdims=True)
    rows["rotation"] = _bytes(rotation * 128 + 128)
    return rows.tobytes()


def _opacity(gaussians: Float[np.ndarray, "point 62"]) -> Float[np.ndarray, " point"]:
    return 1 / (1 + np.exp(-gaussians[:, OPACITY].astype(np.float64)))


def _bytes(values: np.ndarray) -> UInt8[np.ndarray, "*any"]:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8)
